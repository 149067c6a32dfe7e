# Every target creates its environment and installs its requirements, with Python 3.11 or later and make.

# On Windows, targets run in a shell such as that of Git, and environments have their programs in Scripts.
PYTHON ?= $(if $(filter Windows_NT,$(OS)),python,python3)
SCRIPTS := $(if $(filter Windows_NT,$(OS)),Scripts,bin)
VENV := .venv
BIN := $(VENV)/$(SCRIPTS)
OUT ?= out
# Modules are compiled to bytecode when they are imported: most of those of the dependencies never are.
INSTALL := -m pip install --quiet --no-compile
# Arguments for pytest in all test targets.
PYTEST_ARGS ?=
# Bytecode is stored next to the sources, even where the environment disables it: each process would compile the package and its tests.
unexport PYTHONDONTWRITEBYTECODE
PARALLEL := --numprocesses auto --maxprocesses 4 --dist loadfile
# Slow tests often wait for other programs and for browsers: one process more than there are cores, at most five.
WAITING = $(PARALLEL) --numprocesses $(shell n=$$(getconf _NPROCESSORS_ONLN) && echo $$((n < 4 ? n + 1 : 5)))

# Lower bounds of pyproject.toml on the oldest Python: .venv-lowest/uv resolves them, .venv-lowest/env contains them.
LOWEST := .venv-lowest
LOWEST_PYTHON ?= 3.11
UV := $(LOWEST)/uv/$(SCRIPTS)/uv
# Arguments of release/check.py and benchmarks/gpu.py.
CHECK_ARGS ?=
GPU_ARGS ?=
# Effort of the tests in the other environments: all, or default without the slow ones.
EFFORT ?= all
# PyTorch has a separate environment, since its wheel may install gigabytes of CUDA libraries.
TORCH_VENV ?= .venv-torch
# So have the programs whose files are read.
INTEROP_VENV ?= .venv-interop
CHECK_PYTHON = command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found; specify one with: make PYTHON=..."; exit 1; }; \
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	{ echo "foveasim requires Python 3.11 or later; specify one with: make PYTHON=python3.12"; exit 1; }

.PHONY: demo test test-all test-nightly test-pages test-core test-lowest test-torch test-gpu test-interop soak lint lint-js bench bench-torch validate release-check peers docs clean
.NOTPARALLEL:

demo: $(VENV)/.installed
	$(BIN)/foveasim demo --out $(OUT)

# All tests but the slow ones; those of single files or directories with PYTEST_ARGS="tests/cli", which contains the slow ones.
test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest $(PARALLEL) $(PYTEST_ARGS)

# The wheel without extras, outside the repository: every function and command works, or names the extra that it requires.
test-core:
	@$(CHECK_PYTHON)
	directory=$$(mktemp -d) && trap 'rm -rf "$$directory"' EXIT && $(PYTHON) -m venv "$$directory/env" && \
		"$$directory/env/$(SCRIPTS)/python" -m pip wheel --quiet --no-deps --wheel-dir "$$directory" . && \
		"$$directory/env/$(SCRIPTS)/python" -m pip install --quiet "$$directory"/foveasim-*.whl && \
		cp tests/installation/calls.py "$$directory" && cd "$$directory" && MPLBACKEND=agg env -u PYTHONPATH \
		env/$(SCRIPTS)/python calls.py --program env/$(SCRIPTS)/foveasim

# The slow tests, too, those in a browser, all pairs of features and invariants in tests/compositions instead of a sample, and a third
# of the tests marked nightly, which FOVEASIM_TESTS_COMMIT selects.
test-all: $(VENV)/.installed-dev
	FOVEASIM_TESTS=all $(BIN)/python -m pytest $(WAITING) $(PYTEST_ARGS)

# All tests, with all of those marked nightly, and all invariants for all pairs of features.
test-nightly: $(VENV)/.installed-dev
	FOVEASIM_TESTS=nightly $(BIN)/python -m pytest $(WAITING) $(PYTEST_ARGS)

# All tests in a browser.
test-pages: $(VENV)/.installed-dev
	FOVEASIM_TESTS=nightly FOVEASIM_TESTS_NEED=chromium $(BIN)/python -m pytest $(PARALLEL) -m pages $(PYTEST_ARGS)

# Deprecation warnings between old versions of dependencies are ignored.
test-lowest: $(LOWEST)/.installed
	FOVEASIM_TESTS=$(EFFORT) NUMBA_CACHE_DIR="$(CURDIR)/$(LOWEST)/numba" $(LOWEST)/env/$(SCRIPTS)/python -m pytest $(PARALLEL) \
		-W default::DeprecationWarning -W default::PendingDeprecationWarning -W error::pytest.PytestWarning $(PYTEST_ARGS)

test-torch: $(TORCH_VENV)/.installed
	FOVEASIM_TESTS=$(EFFORT) FOVEASIM_TESTS_NEED=torch $(TORCH_VENV)/$(SCRIPTS)/python -m pytest $(PARALLEL) tests/learn \
		tests/integrate/test_vertex_gradient.py tests/explore/test_dataset_torch.py $(PYTEST_ARGS)
	FOVEASIM_TESTS=$(EFFORT) FOVEASIM_TESTS_NEED=torch,deepinv,torchvision $(TORCH_VENV)/$(SCRIPTS)/python -m pytest $(PARALLEL) tests/test_docs.py \
		tests/test_doctests.py tests/test_gallery.py tests/test_notebooks.py tests/installation -k "torch or learn or adapters" $(PYTEST_ARGS)

# Tests and rates of the layers of PyTorch on a GPU, at most six minutes after installation; without a GPU, only says so.
test-gpu: $(TORCH_VENV)/.installed
	$(TORCH_VENV)/$(SCRIPTS)/python benchmarks/gpu.py $(GPU_ARGS)

# Files of other programs, which these write and read; their dependencies may have deprecation warnings among each other.
test-interop: $(INTEROP_VENV)/.installed
	FOVEASIM_TESTS=all FOVEASIM_TESTS_NEED=interop $(INTEROP_VENV)/$(SCRIPTS)/python -m pytest $(PARALLEL) -W default::DeprecationWarning tests/interop \
		tests/distortion/test_calibration_files.py tests/_io/test_picture_colours.py tests/video/test_frame_times.py \
		tests/video/test_video_colours.py $(PYTEST_ARGS)
	FOVEASIM_TESTS=all $(INTEROP_VENV)/$(SCRIPTS)/python -m pytest $(PARALLEL) -W default::DeprecationWarning tests/layout/files/test_chip_records.py tests/maps/test_maps.py \
		-k "klayout or gdstk or astropy" $(PYTEST_ARGS)

# Kills workers at random for some minutes: every item must be computed, or have lost its worker three times.
soak: $(VENV)/.installed-dev
	FOVEASIM_SOAK_ROUNDS=20 $(BIN)/python -m pytest tests/explore/test_executor.py -k lost --verbose $(PYTEST_ARGS)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Types and rules of the JavaScript of the pages; the pages themselves need neither Node nor a build.
lint-js:
	@command -v node >/dev/null && command -v npm >/dev/null || { echo "lint-js requires Node 20 or later with npm"; exit 1; }
	npm ci --silent --no-audit --no-fund
	npm run --silent lint

bench: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/run.py

# Training steps of layouts, against soft masks.
bench-torch: $(TORCH_VENV)/.installed
	$(TORCH_VENV)/$(SCRIPTS)/python benchmarks/gradients.py
	$(TORCH_VENV)/$(SCRIPTS)/python benchmarks/sensor_layers.py

# Every stage against closed forms and other programs; results for the pages in docs/validation.
validate: $(VENV)/.installed-validate $(TORCH_VENV)/.installed
	$(BIN)/python validation/run.py
	$(TORCH_VENV)/$(SCRIPTS)/python validation/run.py learning

# What is built, installed and documented, before a release; some checks with CHECK_ARGS="build version", others without the extras of
# gigabytes with CHECK_ARGS="--without learn adapters".
release-check: $(VENV)/.installed-release
	$(BIN)/python release/check.py $(CHECK_ARGS)

# The same work with other libraries.
peers: $(VENV)/.installed-dev
	$(BIN)/python $(INSTALL) --editable '.[peers]'
	$(BIN)/python benchmarks/peers.py
	$(BIN)/python benchmarks/emva_reference.py

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet --builder html docs docs/_build/html
	$(BIN)/python docs/check_pages.py docs/_build/html
	@echo "open docs/_build/html/index.html"

clean:
	rm -rf $(VENV) $(LOWEST) $(TORCH_VENV) $(INTEROP_VENV) out docs/_build docs/gallery docs/layouts docs/reference docs/results node_modules .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find foveasim tests -name __pycache__ -type d -exec rm -rf {} +

$(VENV)/.made $(LOWEST)/uv/.made $(TORCH_VENV)/.made $(INTEROP_VENV)/.made:
	@$(CHECK_PYTHON)
	$(PYTHON) -m venv $(@D) || { rm -rf $(@D); exit 1; }
	touch $@

$(VENV)/.installed: $(VENV)/.made pyproject.toml
	@echo "installing foveasim into $(VENV) (a minute or so)"
	$(BIN)/python $(INSTALL) --editable '.[view]'
	touch $@

$(VENV)/.installed-dev: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and its development tools into $(VENV), and compiling its kernels (two minutes or so)"
	$(BIN)/python $(INSTALL) --editable '.[dev]'
	$(BIN)/foveasim compile
	touch $@ $(VENV)/.installed

$(VENV)/.installed-validate: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and the programs of its validation into $(VENV) (minutes)"
	$(BIN)/python $(INSTALL) --editable '.[validate]'
	touch $@ $(VENV)/.installed-dev $(VENV)/.installed

$(VENV)/.installed-release: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and the programs of its release into $(VENV) (a minute or so)"
	$(BIN)/python $(INSTALL) --editable '.[release]'
	touch $@ $(VENV)/.installed-docs $(VENV)/.installed-dev $(VENV)/.installed

$(VENV)/.installed-docs: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and its documentation tools into $(VENV) (a minute or so)"
	$(BIN)/python $(INSTALL) --editable '.[docs]'
	touch $@ $(VENV)/.installed-dev $(VENV)/.installed

# Pins the oldest build backend, too, since uv selects the newest.
$(LOWEST)/.installed: $(LOWEST)/uv/.made pyproject.toml
	@echo "installing the lower bounds of the dependencies into $(LOWEST) (a minute or so)"
	$(LOWEST)/uv/$(SCRIPTS)/python -m pip install --quiet uv
	$(UV) venv --quiet --clear --python $(LOWEST_PYTHON) $(LOWEST)/env
	$(LOWEST)/uv/$(SCRIPTS)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")' | \
		$(UV) pip compile --quiet --python $(LOWEST)/env/$(SCRIPTS)/python --resolution lowest-direct --output-file $(LOWEST)/build.txt -
	$(UV) pip install --quiet --python $(LOWEST)/env/$(SCRIPTS)/python --resolution lowest-direct --build-constraints $(LOWEST)/build.txt \
		--editable '.[dev,docs]'
	touch $@

$(TORCH_VENV)/.installed: $(TORCH_VENV)/.made pyproject.toml
	@echo "installing foveasim and PyTorch into $(TORCH_VENV) (minutes with CUDA)"
	$(TORCH_VENV)/$(SCRIPTS)/python $(INSTALL) --editable '.[adapters,explore,layout,learn]' hypothesis ipykernel nbclient onnxruntime onnxscript pytest \
		pytest-timeout pytest-xdist
	touch $@

$(INTEROP_VENV)/.installed: $(INTEROP_VENV)/.made pyproject.toml
	@echo "installing foveasim and the programs whose files it reads into $(INTEROP_VENV) (minutes)"
	$(INTEROP_VENV)/$(SCRIPTS)/python $(INSTALL) --editable '.[interop]'
	touch $@
