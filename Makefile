# Every target makes its own .venv from pyproject.toml and constraints.txt; nothing else is needed than python3 (3.11-3.13) and make.
PYTHON ?= python3
BIN := .venv/bin
DEMO := demo-out

.PHONY: demo test check benchmark clean

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $@

test: .venv/ready
	$(BIN)/python -m pytest -n 2 -m "not slow"

check: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

benchmark: .venv/ready
	$(BIN)/python -m tests.benchmark

clean:
	rm -rf .venv $(DEMO)
