# The pipeline and the checks. `make help` lists the targets.
SHELL := /bin/bash
PYTHON ?= python3
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
SEED ?= 0
DEMO ?= demo
VENV := .venv
BIN := $(VENV)/bin
EVETAC := $(BIN)/evetac
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

# Training and test trajectories have seeds of their own. Labels and tracks are made from the recordings alone.
demo: $(READY)  ## from touch to grasp on a simulated sensor, a few minutes; results in demo/ (SEED, JOBS, DEMO)
	@started=$$(date +%s); set -e; run() { echo "+ evetac $$*"; $(EVETAC) "$$@"; }; \
	run record --scene slip --object 3,6,8,9 --count 6 --seed $(SEED) --out $(DEMO)/learn --jobs $(JOBS) --quiet; \
	run record --scene slip --object 4,8,11 --count 3 --seed $$(( $(SEED) + 1000 )) --out $(DEMO)/unseen --jobs $(JOBS) --quiet; \
	for part in learn unseen; do \
	  run track $(DEMO)/$$part/*.recording.h5 --jobs $(JOBS) --quiet; \
	  run label $(DEMO)/$$part/*.recording.h5 --after-ms 25 --jobs $(JOBS) --quiet; \
	  run featurize $(DEMO)/$$part/*.recording.h5 --jobs $(JOBS) --quiet; \
	done; \
	run train $(DEMO)/learn/*.features.h5 --recipe adam --epochs 30 --seed $(SEED) --validate '$(DEMO)/learn/*-005.features.h5' --out $(DEMO)/slip.model.h5 --quiet; \
	run evaluate labels $(DEMO)/unseen/*.labels.h5 --out $(DEMO)/labels.report.h5 --quiet; \
	run evaluate tracking $(DEMO)/unseen/*.tracks.h5 --out $(DEMO)/tracking.report.h5 --quiet; \
	run evaluate slip $(DEMO)/unseen/*.features.h5 --model $(DEMO)/slip.model.h5 --out $(DEMO)/slip.report.h5 --quiet; \
	run grasp --object 11 --seed $(SEED) --model $(DEMO)/slip.model.h5 --lift-s 7 --balance-s 5 --out $(DEMO)/with-detector.recording.h5 --quiet; \
	run grasp --object 11 --seed $(SEED) --controller none --lift-s 7 --balance-s 0 --out $(DEMO)/without-detector.recording.h5 --quiet; \
	run evaluate grasp $(DEMO)/with-detector.recording.h5 $(DEMO)/without-detector.recording.h5 --out $(DEMO)/grasp.report.h5 --quiet; \
	$(BIN)/python scripts/demo_table.py $(DEMO) $$(( $$(date +%s) - started ))

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
