# make demo: the whole job on the bundled example.   make test and test-fast, test-all: the tests.   All make .venv first.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
TORCH := torch==2.13.0

.DEFAULT_GOAL := help
.PHONY: help venv demo test test-fast test-all clean

help:
	@echo "make demo       fuse, fit, eval, synth and inspect the bundled example; results in demo/"
	@echo "make test-fast  run the tests of a working day"
	@echo "make test       run the tests that every change must pass"
	@echo "make test-all   run these, and what takes long: more scenes, more bounds"
	@echo "make venv       only make .venv with the pinned dependencies"
	@echo "make clean      remove .venv and demo/"

venv: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --disable-pip-version-check --no-compile -q -c constraints.txt $(TORCH) -e '.[dev]'
	@touch $@

demo: venv
	$(BIN)/python examples/demo.py

test test-fast test-all: export PYTHONDONTWRITEBYTECODE :=  # else every process compiles all of it again
PYTEST = $(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder  # few tests may take long

test: venv
	$(PYTEST) -m "not long"

test-fast: venv
	$(PYTEST) -m "not slow and not long"

test-all: venv
	$(PYTEST)

clean:
	rm -rf .venv demo
