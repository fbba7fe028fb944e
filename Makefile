# demo: separate a photograph.  test: everything CI runs.  The rest is for those who change brewster.
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
export BREWSTER_DATA ?= $(wildcard ../shared/data)
PHOTO ?= tests/pictures

.PHONY: demo test test-slow coverage check docs bench mutants dist clean

demo: .venv/core
	$(BIN)/python runs/demo.py "$(PHOTO)"

test: .venv/dev
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

test-slow: .venv/dev
	$(BIN)/python -m pytest -m slow

coverage: .venv/dev
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --cov --cov-report term

check: .venv/dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m brewster.cli.reference | diff docs/reference.md - || { echo "docs/reference.md is out of date: run make docs"; exit 1; }

docs: .venv/dev
	$(BIN)/python -m brewster.cli.reference > docs/reference.md

dist:
	PYTHON=$(PYTHON) .ci/release

bench: .venv/dev
	$(BIN)/python bench/run.py

mutants: .venv/dev
	$(BIN)/python bench/mutants.py

clean:
	rm -rf .venv out build dist src/*.egg-info

.venv/core: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/dev: .venv/core
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@
