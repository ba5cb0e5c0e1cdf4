# The pipeline and the checks. `make help` lists the targets.
SHELL := /bin/bash
PYTHON ?= python3
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
SEED ?= 0
DEMO ?= demo
VENV := .venv
BIN := $(VENV)/bin
EVETAC := $(CURDIR)/$(BIN)/evetac
READY := $(VENV)/.ready

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-all check bench clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

setup: $(READY)  ## make a virtual environment of its own in .venv

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[camera,plot,dev]'
	@touch $@

# Trajectories to learn from, to choose threshold and checkpoint on, and to be judged on have seeds of their own.
demo: $(READY)  ## from touch to grasp on a simulated sensor, a few minutes; results in demo/ (SEED, JOBS, DEMO)
	@set -e; started=$$(date +%s.%N); mkdir -p $(DEMO); cd $(DEMO); \
	run() { echo "+ evetac $$*"; $(EVETAC) $$* --quiet; }; \
	run record --object 3,6,8,9 --count 5 --seed $(SEED) --out learn --jobs $(JOBS); \
	run record --object 3,6,8,9 --seed $$(( $(SEED) + 500 )) --out choose --jobs $(JOBS); \
	run record --object 4,8,11 --count 3 --seed $$(( $(SEED) + 1000 )) --out unseen --jobs $(JOBS); \
	run track "*/*.recording.h5" --jobs $(JOBS); \
	run label "*/*.recording.h5" --after-ms 25 --jobs $(JOBS); \
	run featurize "*/*.recording.h5" --jobs $(JOBS); \
	run train "learn/*.features.h5" --validate choose --recipe adam --epochs 30 --seed $(SEED) --out slip.model.h5; \
	run evaluate labels "unseen/*.labels.h5" --out labels.report.h5; \
	run evaluate tracking "unseen/*.tracks.h5" --out tracking.report.h5; \
	run evaluate slip "unseen/*.features.h5" --model slip.model.h5 --out slip.report.h5; \
	run grasp --object 11 --seed $(SEED) --model slip.model.h5 --lift-s 7 --balance-s 5 --out with-detector.recording.h5; \
	run grasp --object 11 --seed $(SEED) --controller none --lift-s 7 --balance-s 0 --out without-detector.recording.h5; \
	run evaluate grasp "with*-detector.recording.h5" --out grasp.report.h5; \
	$(CURDIR)/$(BIN)/python $(CURDIR)/scripts/demo_table.py $$started

test: $(READY)  ## the test suite
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile -m 'not slow'

test-all: $(READY)  ## the test suite with its longer cases
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

check: $(READY)  ## ruff and mypy --strict
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY)  ## run times of the kernels, as ratios to real time and to each other in one run
	$(BIN)/python scripts/bench.py

clean:  ## remove what demo, tests and builds left; the environment stays
	rm -rf $(DEMO) dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
