# demo: separate photographs.  test: all tests except the slow ones.  test-all: also the slow tests, with browser and Mitsuba.
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
export BREWSTER_DATA ?= $(wildcard ../shared/data)
PHOTO ?= tests/pictures
# A crashed worker must end the run (loadfile would wait for it forever), and so must C code that hangs: pytest-timeout
# (pyproject.toml) ends only tests that return to Python, eight seconds earlier.
FAIL_FAST := --max-worker-restart=0 -o faulthandler_timeout=118 -o faulthandler_exit_on_timeout=true

.PHONY: demo test test-slow test-all test-system coverage check docs docs-site bench mutants dist clean

demo: .venv/core
	$(BIN)/python runs/demo.py "$(PHOTO)"

test: .venv/dev
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile $(FAIL_FAST)

test-slow: .venv/dev
	$(BIN)/python -m pytest -m slow

coverage: .venv/dev
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile $(FAIL_FAST) --cov --cov-report term

test-all: test-system test test-slow

# System packages that some tests need; without them, these tests are skipped.
test-system:
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; \
	then apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium libatomic1; \
	else echo "not root on Debian: to run all tests, install the packages chromium and libatomic1"; fi

check: .venv/dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	.ci/check_page
	$(BIN)/python runs/write_reference.py | diff docs/reference.md - || { echo "docs/reference.md is out of date: run make docs"; exit 1; }
	$(BIN)/python runs/write_reference.py recipes | diff docs/recipes.md - || { echo "docs/recipes.md is out of date: run make docs"; exit 1; }

docs: .venv/dev
	$(BIN)/python runs/write_reference.py > docs/reference.md
	$(BIN)/python runs/write_reference.py recipes > docs/recipes.md
	$(BIN)/python runs/write_tree.py

# The site of the documentation in out/site; needs no network, and a broken link ends it.
docs-site: .venv/dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

dist:
	PYTHON=$(PYTHON) .ci/release

bench: .venv/dev
	$(BIN)/python bench/run.py

# Changes the modules listed in pyproject.toml one expression at a time, and prints the changes that no test notices.
# ONLY names some of them: make mutants ONLY='brewster.photo.srgb.*'
mutants: .venv/dev
	$(BIN)/mutmut run $(ONLY)
	$(BIN)/mutmut results

clean:
	rm -rf .venv out build dist mutants src/*.egg-info

.venv/core: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/dev: .venv/core
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@
