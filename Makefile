# Every target makes its environment and installs what it needs; nothing but Python 3.11 or later and make is expected.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
# Arguments of pytest in all test targets: make test PYTEST_ARGS="tests/cli"
PYTEST_ARGS ?=
PARALLEL := --numprocesses auto --maxprocesses 4 --dist loadgroup

# The oldest versions that pyproject.toml admits, on the oldest Python: .venv-lowest/uv chooses them, .venv-lowest/env has them.
LOWEST := .venv-lowest
LOWEST_PYTHON ?= 3.11
UV := $(LOWEST)/uv/bin/uv
# PyTorch has an environment of its own, as its wheel may bring gigabytes of CUDA libraries.
TORCH_VENV ?= .venv-torch

.PHONY: demo test test-lowest test-torch soak lint bench docs clean
.NOTPARALLEL:

demo: $(VENV)/.installed
	$(BIN)/foveasim demo --out $(OUT)

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest $(PARALLEL) $(PYTEST_ARGS)

# Deprecations that old versions find in new ones of what they use are theirs.
test-lowest: $(LOWEST)/.installed
	NUMBA_CACHE_DIR="$(CURDIR)/$(LOWEST)/numba" $(LOWEST)/env/bin/python -m pytest $(PARALLEL) \
		-W default::DeprecationWarning -W default::PendingDeprecationWarning -W error::pytest.PytestWarning $(PYTEST_ARGS)

test-torch: $(TORCH_VENV)/.installed
	FOVEASIM_TESTS_NEED=torch $(TORCH_VENV)/bin/python -m pytest tests/explore/test_dataset_torch.py $(PYTEST_ARGS)

# Kills workers at random for some minutes: every item must be computed, and none more than twice.
soak: $(VENV)/.installed-dev
	FOVEASIM_SOAK_ROUNDS=20 $(BIN)/python -m pytest tests/explore/test_executor.py -k lost --verbose $(PYTEST_ARGS)

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/run.py

docs: $(VENV)/.installed-docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet --builder html docs docs/_build/html
	@echo "the site begins at docs/_build/html/index.html"

clean:
	rm -rf $(VENV) $(LOWEST) $(TORCH_VENV) out docs/_build docs/gallery docs/reference .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find foveasim tests -name __pycache__ -type d -exec rm -rf {} +

$(VENV)/.made $(LOWEST)/uv/.made $(TORCH_VENV)/.made:
	@command -v $(PYTHON) >/dev/null || { echo "there is no $(PYTHON); name a Python with: make PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "foveasim needs Python 3.11 or later; name one with: make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(@D) || { rm -rf $(@D); exit 1; }
	touch $@

$(VENV)/.installed: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and what it needs into $(VENV) (a minute or so)"
	$(BIN)/python -m pip install --quiet --editable '.[view]'
	touch $@

$(VENV)/.installed-dev: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and its development tools into $(VENV) (a minute or so)"
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and what its documentation is made with into $(VENV) (a minute or so)"
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@ $(VENV)/.installed-dev $(VENV)/.installed

# The oldest build backend too, which uv chooses of its own accord the newest.
$(LOWEST)/.installed: $(LOWEST)/uv/.made pyproject.toml
	@echo "installing the oldest versions that foveasim admits into $(LOWEST) (a minute or so)"
	$(LOWEST)/uv/bin/python -m pip install --quiet uv
	$(UV) venv --quiet --clear --python $(LOWEST_PYTHON) $(LOWEST)/env
	$(LOWEST)/uv/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")' | \
		$(UV) pip compile --quiet --python $(LOWEST)/env/bin/python --resolution lowest-direct --output-file $(LOWEST)/build.txt -
	$(UV) pip install --quiet --python $(LOWEST)/env/bin/python --resolution lowest-direct --build-constraints $(LOWEST)/build.txt \
		--editable '.[dev,docs]'
	touch $@

$(TORCH_VENV)/.installed: $(TORCH_VENV)/.made pyproject.toml
	@echo "installing foveasim and PyTorch into $(TORCH_VENV) (minutes, where PyTorch brings CUDA)"
	$(TORCH_VENV)/bin/python -m pip install --quiet --editable '.[explore,learn]' pytest
	touch $@
