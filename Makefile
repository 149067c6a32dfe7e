# Every target makes .venv and installs what it needs; nothing but Python 3.11 or later and make is expected.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out

.PHONY: demo test lint bench docs clean
.NOTPARALLEL:

demo: $(VENV)/.installed
	$(BIN)/foveasim demo --out $(OUT)

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

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
	rm -rf $(VENV) out docs/_build docs/gallery docs/reference .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find foveasim tests -name __pycache__ -type d -exec rm -rf {} +

$(VENV)/.made:
	@command -v $(PYTHON) >/dev/null || { echo "there is no $(PYTHON); name a Python with: make PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "foveasim needs Python 3.11 or later; name one with: make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }
	touch $@

$(VENV)/.installed: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and what it needs into $(VENV) (a minute or so)"
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and its development tools into $(VENV) (a minute or so)"
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: $(VENV)/.made pyproject.toml
	@echo "installing foveasim and what its documentation is made with into $(VENV) (a minute or so)"
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@ $(VENV)/.installed-dev $(VENV)/.installed
