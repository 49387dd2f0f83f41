# Everything that a checkout can do. Needs only make and Python 3.11 or newer: the rest is installed
# into .venv, once, in the versions that constraints.txt names.

PYTHON  ?= python3
WORKERS ?= 2
DRAW    ?= 1

VENV  := .venv
BIN   := $(VENV)/bin
STAMP := $(VENV)/.installed
DOCS  := $(VENV)/.installed-docs

CHECKER  := build/undertow-checker
OPTIMISE := -O2

# Python keeps what it compiles, whatever the environment says: the tests start many processes.
unexport PYTHONDONTWRITEBYTECODE

# Workers have the cores: threads of BLAS beside them would wait for each other.
test slow coverage: export OPENBLAS_NUM_THREADS = 1

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo test slow coverage check bench docs checker clean

help: ## list the targets
	@echo "Undertow: make <target>    (PYTHON=$(PYTHON), WORKERS=$(WORKERS))"
	@sed -n 's/^\([a-z]*\):.*## \(.*\)$$/  \1	\2/p' Makefile

setup: $(STAMP) ## install everything into .venv (the other targets do it by themselves)

demo: $(STAMP) ## repeat the paper's experiment, tables and figures into results/
	$(BIN)/undertow reproduce --out results

test: $(STAMP) ## run the tests, but for the slow ones
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

# With MINUTES=20, say, so much of them as fits, their files in the order that DRAW draws.
slow: $(STAMP) ## run the slow tests, or those that MINUTES leave time for
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m slow \
	    $(if $(MINUTES),--minutes=$(MINUTES) --draw=$(DRAW)) || [ $$? -eq 5 ]

# What is compiled runs in Python, too, a part of the time: tests/compiled_lines.py. Which test
# reaches which line is kept in .coverage, where tests/mutants.py looks it up.
coverage: $(STAMP) ## run the tests, and list the lines of src that none of them reaches
	COVERAGE_FILE=$(CURDIR)/.coverage $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal \
	    --count-compiled --cov=undertow --cov-context=test --cov-report=term --cov-fail-under=92

check: $(STAMP) ## formatting, lint, types, direction of imports
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

bench: $(STAMP) ## all benchmarks, with a summary (docs/benchmarks.md says what they mean)
	$(BIN)/python benchmarks

docs: $(DOCS) ## build the documentation site, build/docs/index.html, running its gallery
	rm -rf docs/api build/docs
	MPLBACKEND=agg $(BIN)/python -m sphinx -b html -W --keep-going -q -d build/doctrees docs build/docs
	$(BIN)/undertow show rotary_pendulum --start phi=35deg --objective bench-time --save build/docs/replay.html
	$(BIN)/python docs/check_links.py build/docs

checker: $(CHECKER) ## build the second checker of certificates (needs a C++17 compiler)

# One rounding mode for the whole run: -frounding-math, and no fused operations.
$(CHECKER): checker/checker.cpp $(wildcard checker/*.hpp)
	@command -v $(firstword $(CXX)) >/dev/null || { \
	    echo "error: no C++ compiler found under the name '$(CXX)'."; \
	    echo "Install g++ or clang++ (12 or newer), or name one: make checker CXX=/path/to/c++"; \
	    exit 1; } >&2
	@mkdir -p $(@D)
	$(CXX) -std=c++17 $(OPTIMISE) -frounding-math -ffp-contract=off -Wall -Wextra -o $@ checker/checker.cpp

clean: ## remove .venv, caches and results/
	rm -rf $(VENV) results dist build docs/api docs/gallery
	rm -rf .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .coverage*
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

# One environment for all targets, made afresh when what it is made from changes.
$(STAMP): pyproject.toml constraints.txt
	@command -v "$(PYTHON)" >/dev/null || { \
	    echo "error: no Python found under the name '$(PYTHON)'."; \
	    echo "Install Python 3.11 or newer, or name one: make PYTHON=/path/to/python"; \
	    exit 1; } >&2
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "error: Undertow needs Python 3.11 or newer; '$(PYTHON)' is $$("$(PYTHON)" --version 2>&1)."; \
	    echo "Name a newer one: make PYTHON=/path/to/python"; \
	    exit 1; } >&2
	@"$(PYTHON)" -m venv --clear $(VENV) || { \
	    echo "error: '$(PYTHON) -m venv' failed; some systems package it apart (python3-venv)."; \
	    exit 1; } >&2
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[appendix,bounds,campaign,compare,gym,interop,logs,mujoco,show,dev]'
	@touch $@

# What builds the site comes on top, for those who build it.
$(DOCS): $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@touch $@
