# Everything runs inside .venv, which each target makes when it is missing or older than pyproject.toml.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install demo test lint check clean pardiso benchmark-setup

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]"
	touch $@

# Intel's PARDISO alone, which benchmarks/speed.py --parts solver compares our solver with; nothing else uses it.
pardiso: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "pypardiso>=0.4.6"

# All peers that benchmarks/speed.py compares with. A torch for processors alone is a tenth of the size:
# make benchmark-setup TORCH=torch==2.13.0+cpu, where the package index has one.
TORCH ?= torch
benchmark-setup: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "$(TORCH)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[benchmark]"

demo: install
	$(BIN)/palpate demo --output demo-output

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/mypy

test: lint
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal

check: test

clean:
	rm -rf $(VENV) demo-output build dist .mypy_cache .pytest_cache .ruff_cache
