PYTHON ?= python3
VENV ?= .venv
CONSTRAINTS ?= constraints.txt
NUM ?= 9000

RUN_NAME = $(shell date +%Y%m%d-%H%M%S)
PYTHON_VERSION = $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')
PIP = $(VENV)/bin/python -m pip --disable-pip-version-check
# Workers get whole modules in the order of tests/conftest.py, the longest first.
PYTEST = $(VENV)/bin/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder
# What shows soonest that an interpreter, or the versions pinned for it, differ from the usual.
SHORT = public_names cli solve decide referee_hit serves
COMPILE = $(VENV)/bin/uv pip compile pyproject.toml --universal --python-version 3.11 \
	--all-extras --no-annotate --quiet --custom-compile-command "make constraints"

.PHONY: help demo test test-slow coverage test-faults test-short test-wheel test-range test-lowest lint format docs bench \
	constraints clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "%-12s %s\n", $$1, $$2}' Makefile

demo: $(VENV)/.installed-test  ## plan NUM=9000 serves, referee them, write runs/demo-*
	$(VENV)/bin/planner-jax sweep hit --num $(NUM) --out runs/demo-$(RUN_NAME)

test: $(VENV)/.installed-test  ## the default tests
	$(PYTEST) $(TESTS)

test-slow: $(VENV)/.installed-test  ## the tests marked slow
	$(PYTEST) -m "slow and not gpu"

coverage: $(VENV)/.installed-test  ## the share of planner_jax's lines that default and slow tests run
	$(PYTEST) -m "not gpu" --cov --cov-report=term:skip-covered --cov-fail-under=90

test-faults: $(VENV)/.installed-test  ## every fault in numbers: kills, twins, damage, full disks, signals; an hour on 2 cores
	$(VENV)/bin/python -m tests.faults --jobs $$(nproc) --out build/faults.md

test-wheel: $(VENV)/.installed-test  ## a wheel in an environment of its own: 1.3 GB, then removed
	PLANNER_JAX_WHEEL=whole $(VENV)/bin/python -m pytest -m slow -o tmp_path_retention_policy=failed \
	    tests/test_wheel.py

test-short:  ## a few quick modules under another interpreter: PYTHON=python3.12
	$(MAKE) test VENV=.venv-$(PYTHON_VERSION) TESTS='$(SHORT:%=tests/test_%.py)'

test-range:  ## default and slow tests under another interpreter: PYTHON=python3.12
	$(MAKE) test test-slow VENV=.venv-$(PYTHON_VERSION)

test-lowest:  ## default and slow tests with the oldest versions that pyproject.toml admits
	$(MAKE) test test-slow VENV=.venv-lowest CONSTRAINTS=constraints-lowest.txt

lint: $(VENV)/.installed-dev  ## linter, formatter (check only), type checker
	$(VENV)/bin/ruff check
	$(VENV)/bin/ruff format --check
	$(VENV)/bin/pyright --pythonpath $(VENV)/bin/python

format: $(VENV)/.installed-dev  ## rewrite the code as `make lint` wants it
	$(VENV)/bin/ruff check --fix
	$(VENV)/bin/ruff format

docs: $(VENV)/.installed-docs  ## the documentation site, into build/site
	$(VENV)/bin/python docs/build_site.py

bench: $(VENV)/.installed-test $(VENV)/.installed-oracle  ## every program of benchmarks/
	@set -e; for file in $$(grep -l __main__ benchmarks/*.py | grep -v path_peers); do \
	    name=benchmarks.$$(basename $$file .py); \
	    echo "$(VENV)/bin/python -m $$name"; $(VENV)/bin/python -m $$name; \
	done

constraints: $(VENV)/bin/pip  ## resolve both constraints files anew
	$(PIP) install --quiet uv
	$(COMPILE) --upgrade --output-file constraints.txt
	$(COMPILE) --upgrade --output-file constraints-lowest.txt --resolution lowest-direct

clean:  ## remove environments and caches, keep runs/
	rm -rf .venv .venv-* .cache .pytest_cache .ruff_cache build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp .installed-EXTRA says that the environment holds the project with that extra; dev
# holds test.
$(VENV)/.installed-%: pyproject.toml $(CONSTRAINTS) | $(VENV)/bin/pip
	@echo "Installing the pinned packages into $(VENV): 1.3 GB, once, a minute or two."
	$(PIP) install --quiet --constraint $(CONSTRAINTS) --editable '.[$*]'
	@touch $@ $(if $(filter dev,$*),$(VENV)/.installed-test)

$(VENV)/bin/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	    echo "planner-jax needs Python >= 3.11, and PYTHON=$(PYTHON) is" \
	    "$$($(PYTHON) --version 2>/dev/null || echo 'not there'): name another, as in" \
	    "'make $(or $(MAKECMDGOALS),demo) PYTHON=python3.12'" >&2; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "$(PYTHON) cannot make a virtual environment: install its venv module" \
	    "(on Debian and Ubuntu: apt install python3-venv)" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
