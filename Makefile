# What users type. Every target is one line over `python -m conflow`; `make help` lists them.

ABLATION ?= cgp
SEED     ?= 0
PRESET   ?= quick
PORT     ?= 5000
ARGS     ?=

PYTHON := .venv/bin/python
CONFLOW = $(PYTHON) -m conflow

.DEFAULT_GOAL := help
.PHONY: help train ui test lint lock

help:  ## List what can be made
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' Makefile
	@echo '  Variables: ABLATION=$(ABLATION) SEED=$(SEED) PRESET=$(PRESET) PORT=$(PORT) ARGS="key=value ..."'
	@echo "  Ablations: $(basename $(notdir $(wildcard conf/ablation/*.yaml)))"
	@echo "  Presets:   $(basename $(notdir $(wildcard conf/preset/*.yaml)))"

train: .venv/installed  ## Train, sample, evaluate and track one experiment: ABLATION= SEED= PRESET= ARGS=
	@$(CONFLOW) train ablation=$(ABLATION) seed=$(SEED) preset=$(PRESET) $(ARGS)

ui: .venv/installed  ## Open MLflow's pages of all runs: PORT=
	@$(CONFLOW) ui port=$(PORT)

test: .venv/installed  ## Run the tests
	@$(PYTHON) -m pytest -q $(ARGS)

lint: .venv/installed  ## Check style and types
	@$(PYTHON) -m ruff check conflow tests
	@$(PYTHON) -m ruff format --check conflow tests
	@$(PYTHON) -m mypy conflow tests

lock:  ## Resolve pyproject.toml anew into requirements.lock
	@rm -rf .venv/lock && python3 -m venv .venv/lock
	@.venv/lock/bin/python -m pip install --quiet torch==2.13.0 '.[dev]'
	@.venv/lock/bin/python -m pip freeze --all --exclude pip --exclude conflow | sed 's/+cpu$$//' > requirements.lock
	@rm -rf .venv/lock

# The environment, made once and again when the lock file changes. A failed installation leaves no stamp.
.venv/installed: requirements.lock pyproject.toml
	@echo "Installing the locked environment into .venv (a few minutes, once)"
	@python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "conflow: python3 is $$(python3 --version), expected 3.11 or newer" >&2; exit 2; }
	@test -x $(PYTHON) || python3 -m venv .venv
	@$(PYTHON) -m pip install --quiet --disable-pip-version-check -r requirements.lock
	@$(PYTHON) -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@
