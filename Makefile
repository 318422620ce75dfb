# make demo | ar-demo | train-demo | test | lint | bench | install: each installs what it needs into .venv first.
# make clean removes .venv and what tools left; outputs stay.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo ar-demo train-demo test lint bench install clean help

demo: install
	$(BIN)/python run.py task=demo refine=true

ar-demo: install
	$(BIN)/python run.py task=ar recording=synthetic segmentation=curtain refine=fast

train-demo: install
	$(BIN)/python run.py sweep=demo

test: install
	$(BIN)/python -m pytest -n auto --dist worksteal

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: install
	$(BIN)/python -m pip install --quiet --editable '.[dev,open3d,pyrender]'
	$(BIN)/python -m tests.benchmarks.pipeline

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; name one: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || \
	  { echo "this Python cannot make virtual environments; on Debian: apt install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .mypy_cache

help:
	@sed -n 's/^# //p' Makefile
