# SPDX-License-Identifier: Apache-2.0
PYTHON ?= python3
VENV ?= .venv
OUT ?= out/demo
SEED ?= 2026
COUNT ?= 40
BIN := $(VENV)/bin
comma := ,
STAMP := $(VENV)/.installed
DEMO_STAMP := $(VENV)/.installed-demo
COMPILED := $(VENV)/.compiled
# The environment of the tests has all that the demo needs; without one, a smaller one is installed.
DEMO_ENVIRONMENT := $(if $(wildcard $(STAMP)),$(STAMP),$(DEMO_STAMP))

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_ROOT_USER_ACTION := ignore
export PIP_NO_WARN_SCRIPT_LOCATION := 1
MAPS := $(wildcard ../shared/data)
ifneq ($(MAPS),)
export MANYEYES_MAPS ?= $(abspath $(MAPS))
export MANYEYES_TOWNS ?= $(abspath $(MAPS)/carla_opendrive)
endif
export PYTHONWARNINGS := ignore:::pip
export OMP_NUM_THREADS ?= 1
# Without kept bytecode every process compiles every module that it imports; tests start hundreds of processes.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help venv demo test test-fast test-nightly probes coverage mutants check docs wheel wheels format bench clean
.DEFAULT_GOAL := help

help:
	@echo "make demo          simulate a drive, evaluate the methods on it: table, figures, report in $(OUT)"
	@echo "make test-fast     tests without training and without slow ones, in two minutes; 20 hypothesis examples each"
	@echo "make test          every test, in two processes; 200 hypothesis examples each"
	@echo "make test-nightly  every test; 2,000 hypothesis examples each, other ones in every run"
	@echo "make probes        hostile packets, kills, races and the like at full length, in hours"
	@echo "make coverage      every test, and the fraction of statements that they run, by module"
	@echo "make mutants       40 mutations of the source, drawn by SEED, each against the tests of its module; lists the survivors"
	@echo "make check         formatting, lint, types, layers"
	@echo "make docs          the documentation site in out/site, for a browser without a server; warnings are errors"
	@echo "make wheel         build the wheel and run demo, pose and map fuse from it in an empty environment"
	@echo "make wheels        the same for every set of extras and Python version, and the README's install lines; half an hour"
	@echo "make format        rewrite the sources in the house format"
	@echo "make bench         the speed benchmarks, each with its stored result"
	@echo "make clean         remove the environment, outputs and caches"

venv: $(STAMP)
	@$(MAKE) --no-print-directory $(COMPILED)

define install
	@$(PYTHON) -c 'import sys; sys.exit("manyeyes: the pinned environment needs Python 3.11 or later; say make PYTHON=python3.11" if sys.version_info < (3, 11) else 0)'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV); the first time takes some minutes."
	@$(BIN)/python -m pip install -qq --constraint constraints.txt --editable '.[$(1)]'
	@touch $@
endef

$(STAMP): pyproject.toml constraints.txt
	$(call install,dev)

$(DEMO_STAMP): pyproject.toml constraints.txt
	$(call install,sim$(comma)view)

# The last step of the installation for the demo. The tests compile what each of them needs.
$(COMPILED): $(DEMO_ENVIRONMENT)
	@echo "Compiling the loops of the demo, in two processes."
	@$(BIN)/manyeyes doctor --compile
	@touch $@

demo: $(COMPILED)
	@$(BIN)/manyeyes demo --out $(OUT)

test: $(STAMP)
	@$(BIN)/python -m pytest -n 2 --dist loadfile

test-fast: $(STAMP)
	@HYPOTHESIS_PROFILE=fast $(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow and not training"

test-nightly: $(STAMP)
	@HYPOTHESIS_PROFILE=nightly $(BIN)/python -m pytest

probes: $(STAMP)
	@MANYEYES_PROBES=long nice -n 10 $(BIN)/python -m pytest tests/probes

coverage: $(STAMP)
	@$(BIN)/python -m pytest --cov=manyeyes --cov-report=term:skip-covered

mutants: $(STAMP)
	@$(BIN)/python tests/probes/mutants.py --seed $(SEED) --count $(COUNT)

check: $(STAMP)
	@$(BIN)/ruff format --check --quiet .
	@$(BIN)/ruff check --quiet .
	@$(BIN)/basedpyright
	@$(BIN)/lint-imports --no-cache

docs: $(STAMP)
	@$(BIN)/python scripts/reference_pages.py --check
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "out/site/index.html"

wheel:
	@PYTHON=$(PYTHON) bash .ci/wheel

wheels:
	@nice -n 10 $(PYTHON) scripts/wheels.py

format: $(STAMP)
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

bench: $(STAMP)
	@set -e; for script in $(sort $(shell grep -l __main__ benchmarks/*.py)); do echo "== $$script"; $(BIN)/python $$script; done

clean:
	@rm -rf $(VENV) out dist .ruff_cache .hypothesis .import_linter_cache
	@find src tests examples benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
