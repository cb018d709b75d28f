# What users type. Every command of `python -m conflow` is a target of one line; `make help` lists them.

TASK     ?= swap
ABLATION ?= cgp
SEED     ?= 0
# Of one training; results are the same up to rounding.
DEVICES  ?= 1
PRESET   ?= quick
SEEDS    ?= 0 1 2
ABLATIONS ?= $(basename $(notdir $(wildcard conf/ablation/*.yaml)))
JOBS     ?= 1
# A Ray cluster for `make ablations`: auto or host:port; and what each cell gets of it.
CLUSTER  ?=
CPUS     ?= 1
GPUS     ?= 0
RUN      ?= latest
# Tracks of people or robots, for `make demonstrations`.
FROM     ?=
# What results are shown of: methods and settings are chosen by val, and reported by test.
SPLIT    ?= val
FORMAT   ?= table
REFERENCE ?=
START    ?=
GOAL     ?=
# Of these two every command has its own default.
OUT      ?=
NUM      ?=
PORT     ?= 5000
# Of `make planbench`; how many robots is the task's own number unless given.
N        ?=
SCENES   ?= 64
ARGS     ?=

PYTHON := .venv/bin/python
# A process for each core, and the tests of a file in the same one: they share what is slow to make.
PARALLEL := -n auto --dist loadfile
# Where the examples in docstrings are run as well.
EXAMPLES := conflow/flow conflow/scene conflow/planner.py
CONFLOW = $(PYTHON) -m conflow
# A process for each device.
TOGETHER = $(if $(filter-out 1,$(DEVICES)),-m torch.distributed.run --standalone --nproc-per-node=$(DEVICES))
# A task of one's own, which no run holds.
OWN = $(if $(filter %.py,$(TASK)),task=$(TASK))
# A variable that was given, of which the command has another default than here.
GIVEN = $(if $(filter command environment,$(firstword $(origin $(1)))),$(2)=$($(1)))
WRITTEN = $(if $(OUT),out="$(OUT)") $(if $(NUM),num="$(NUM)")

.DEFAULT_GOAL := help
.PHONY: help train ablations evaluate compare reference sample figures explain demonstrations planbench bench ui test test-faults lint lock

help:  ## List what can be made
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' Makefile
	@echo '  Variables: TASK=$(TASK) ABLATION=$(ABLATION) SEED=$(SEED) PRESET=$(PRESET) PORT=$(PORT) ARGS="key=value ..."'
	@echo "  Ablations: $(basename $(notdir $(wildcard conf/ablation/*.yaml)))"
	@echo "  Tasks:     $(basename $(notdir $(wildcard conf/task/*.yaml))), or a file of your own: TASK=my_task.py"
	@echo "  Presets:   $(basename $(notdir $(wildcard conf/preset/*.yaml)))"

train: .venv/installed  ## Train, sample, evaluate and track one experiment: TASK= ABLATION= SEED= PRESET= SPLIT= DEVICES= ARGS=
	@$(PYTHON) $(TOGETHER) -m conflow train task=$(TASK) ablation=$(ABLATION) seed=$(SEED) preset=$(PRESET) split=$(SPLIT) $(ARGS)

ablations: .venv/installed  ## Train every ablation for every seed, and compare: TASK= SEEDS= ABLATIONS= PRESET= JOBS= SPLIT= ARGS= CLUSTER=auto CPUS= GPUS=
	@$(CONFLOW) ablations task=$(TASK) seeds="$(SEEDS)" ablations="$(ABLATIONS)" preset=$(PRESET) jobs=$(JOBS) split=$(SPLIT) \
	$(if $(CLUSTER),cluster=$(CLUSTER) cpus=$(CPUS) gpus=$(GPUS)) $(ARGS)

evaluate: .venv/installed  ## Sample a finished run again with other settings: RUN= SPLIT=val|test ARGS="sample.steps=50"
	@$(CONFLOW) evaluate $(OWN) run=$(RUN) split=$(SPLIT) $(ARGS)

compare: .venv/installed  ## Print the paper's tables and claims: TASK= PRESET= SPLIT=val|test FORMAT=table|markdown|csv|json REFERENCE=1 (published runs)
	@$(CONFLOW) compare preset=$(PRESET) format=$(FORMAT) $(if $(REFERENCE),reference=1,task=$(TASK) split=$(SPLIT)) $(ARGS)

reference: .venv/installed  ## Publish the numbers of finished runs as files in runs/reference/runs/: PRESET=
	@$(CONFLOW) reference preset=$(PRESET)

sample: .venv/installed  ## Plan from START="x1,y1,x2,y2" to GOAL= and draw it: OUT= NUM= RUN=latest, or none (no model) for TASK, SEED= ARGS="obstacle=x,y,r via=s,x1,y1,..."
	@$(CONFLOW) sample $(if $(filter none,$(RUN)),task=$(TASK),$(OWN)) run=$(RUN) start="$(START)" goal="$(GOAL)" $(WRITTEN) seed=$(SEED) $(ARGS)

figures: .venv/installed  ## Draw the pictures of finished runs into runs/figures/: RUN=latest, or RUN=NAME,NAME,... SPLIT=
	@$(CONFLOW) figures $(OWN) run=$(RUN) split=$(SPLIT)

explain: .venv/installed  ## Draw why the covariant correction works, and what fewer collisions cost: PRESET=
	@$(CONFLOW) explain preset=$(PRESET)

demonstrations: .venv/installed  ## Write demonstrations for ARGS="data.path=FILE": TASK=passing, or FROM=tracks.csv; OUT= NUM= SEED=
	@$(CONFLOW) demonstrations $(if $(FROM),from="$(FROM)",task=$(TASK)) $(WRITTEN) seed=$(SEED) $(ARGS)

planbench: .venv/installed  ## Solve scenes of robots or arms: TASK=weave N=28 SCENES=64 RUN=NAME,NAME or none, OUT= NUM= SEED= FORMAT= REFERENCE=1 (published)
	@$(CONFLOW) planbench $(call GIVEN,TASK,task) n=$(N) scenes=$(SCENES) format=$(FORMAT) $(if $(REFERENCE),reference=1) \
	$(call GIVEN,RUN,run) $(call GIVEN,SEED,seed) $(WRITTEN) $(ARGS)

bench: .venv/installed  ## Measure speed beside other libraries, 6 minutes on an idle machine: FORMAT= REFERENCE=1 (published)
	@$(PYTHON) -m tests.bench format=$(FORMAT) $(if $(REFERENCE),reference=1)

ui: .venv/installed  ## Open MLflow's pages of all runs: PORT=
	@$(CONFLOW) ui port=$(PORT)

test: .venv/installed  ## Run the tests
	@OMP_NUM_THREADS=1 $(PYTHON) -m pytest -q $(PARALLEL) --doctest-modules $(EXAMPLES) tests --ignore=tests/faults $(ARGS)

test-faults: .venv/installed  ## Run the tests that kill processes, fill disks and break files
	@OMP_NUM_THREADS=1 $(PYTHON) -m pytest -q $(PARALLEL) tests/faults $(ARGS)

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
# One shell under one lock, so that of several that are started at once one installs and the others wait for it.
.venv/installed: requirements.lock pyproject.toml
	@exec 9>.venv.lock; ! command -v flock >/dev/null || flock 9; \
	if [ $@ -nt requirements.lock ] && [ $@ -nt pyproject.toml ]; then exit 0; fi; \
	echo "Installing the locked environment into .venv (a few minutes, once)" >&2; \
	python3 -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "conflow: python3 is $$(python3 --version), expected 3.11 or newer" >&2; exit 2; }; \
	{ test -x $(PYTHON) || python3 -m venv .venv; } \
	&& $(PYTHON) -m pip install -qq --disable-pip-version-check -r requirements.lock \
	&& $(PYTHON) -m pip install -qq --disable-pip-version-check --no-deps --editable . \
	&& touch $@
