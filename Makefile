# Everything a newcomer, a developer and CI need. Python 3.11 or newer and make are enough.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# One thread each: the machine's cores are used by processes.
export OMP_NUM_THREADS ?= 1

.PHONY: help train test slow check format lint types clean
.DEFAULT_GOAL := help

help:
	@echo "make train     set up $(VENV), train CTMRL on the starter dataset, print its returns"
	@echo "make test      set up $(VENV), run the fast tests"
	@echo "make slow      the tests that take minutes"
	@echo "make check     format, lint, types and fast tests: what CI runs"
	@echo "make format    format the code and mend what the linter can"
	@echo "make clean     remove $(VENV) and caches (not runs/, not datasets/)"

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed, $(PYTHON) is $$($(PYTHON) -V): make PYTHON=..."; exit 1; }
	@echo "Setting up $(VENV): PyTorch and a few libraries, a minute or more ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	@echo "Adding the development tools to $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

train: $(VENV)/.installed
	@echo "Training CTMRL on the starter dataset of PointRobotWind (python -m ctmrl.train) ..."
	@$(BIN)/python -m ctmrl.train

test: $(VENV)/.installed-dev
	@echo "Running the fast tests (pytest, a process for each of up to 4 cores) ..."
	@$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist worksteal

slow: $(VENV)/.installed-dev
	@echo "Running the slow tests (pytest -m slow) ..."
	@$(BIN)/python -m pytest -m slow

format: $(VENV)/.installed-dev
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

lint: $(VENV)/.installed-dev
	@echo "Checking format and lint (ruff) ..."
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .

types: $(VENV)/.installed-dev
	@echo "Checking types (mypy) ..."
	@$(BIN)/mypy

check: lint types test

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache build *.egg-info
