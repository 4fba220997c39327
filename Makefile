# `make` lists what there is. Everything runs inside .venv, which is made here and renewed when its inputs change.

PYTHON ?= python3
VENV := .venv
READY := $(VENV)/.ready

# More arguments of pip, such as where to find a build of torch without CUDA (see README.md).
PIP_ARGS ?=
# Config overrides for the recipe: make train ARGS="scenario=geant preset=paper".
ARGS ?=
# Processes of the tests.
JOBS ?= 2
# Where the run goes: run_dir=... among ARGS, otherwise runs/dqn.
RUN := $(or $(patsubst run_dir=%,%,$(filter run_dir=%,$(ARGS))),runs/dqn)
# Beside the run and not inside it, since a run is moved and deleted as a whole.
EVALUATION := $(RUN)_evaluation
TRAIN_ARGS := run_dir=$(RUN) $(filter-out run_dir=%,$(ARGS))
# The comparison is made on the network that was trained on, so it gets the scenario's overrides and no others.
EVALUATE_ARGS := method=[random_feasible,greedy,myopic_optimal,checkpoint] checkpoint=$(RUN)/best.pt seeds=10 \
	output=$(EVALUATION) $(filter scenario=% scenario.%,$(ARGS))

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup train test lint docs tensorboard

help:  ## Show this list
	@sed -nE 's/^([a-z]+):.*## (.*)$$/  make \1|\2/p' $(firstword $(MAKEFILE_LIST)) | awk -F'|' '{printf "%-20s %s\n", $$1, $$2}'
	@echo
	@echo 'Config overrides go in ARGS:  make train ARGS="scenario=geant run_dir=runs/geant"'

setup: $(READY)  ## Make .venv with the pinned packages (the other targets do it when needed)

train: $(READY)  ## Train a DQN on random networks, then compare it with the baselines on the scenario
	$(VENV)/bin/python recipes/dqn.py $(foreach arg,$(TRAIN_ARGS),'$(arg)')
	$(VENV)/bin/python recipes/evaluate.py $(foreach arg,$(EVALUATE_ARGS),'$(arg)')
	@echo
	@echo 'Curves:      $(VENV)/bin/tensorboard --logdir $(RUN)'
	@echo 'Checkpoint:  $(RUN)/best.pt'
	@echo 'Evaluation:  $(EVALUATION)'

test: $(READY)  ## Run the tests (ARGS go to pytest)
	$(VENV)/bin/python -m pytest -n $(JOBS) --dist loadfile $(ARGS)

lint: $(READY)  ## Check style with ruff and types with mypy
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

docs: $(READY)  ## Build the documentation in site/
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict
	@echo 'Documentation: site/index.html'

tensorboard: $(READY)  ## Show the curves of all runs
	$(VENV)/bin/tensorboard --logdir runs

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo 'nfv_torchrl needs Python 3.11 or newer, and "$(PYTHON)" is not: set one, as in  make PYTHON=python3.12'; \
		exit 1; }
	@echo 'Setting up $(VENV) (minutes the first time)'
	@$(PYTHON) -m venv $(VENV)
	@$(VENV)/bin/python -m pip install --quiet $(PIP_ARGS) -c constraints.txt -e '.[dev]'
	@touch $@
