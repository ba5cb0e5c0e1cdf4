# The pipeline and the checks. `make help` lists the targets.
SHELL := /bin/bash
PYTHON ?= python3
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
SEED ?= 0
DEMO ?= demo
STRIPS ?= strips
# make slip-data, make slip-table: objects, trajectories of each by role, seeds, and where a training ends.
SLIP ?= data/slip
KNOWN ?= 1-9
UNSEEN ?= 10-17
TRAIN ?= 12
VALIDATE ?= 2
TEST ?= 10
SENSOR ?= evetac
TRACKER ?= stable
SEEDS ?= 5
MODELS ?= no-hist hist10 events-only disp-only hist20 down5 fast-slow
IMAGE_MODELS ?= no-hist-img-6x6 hist10-img-6x6
OURS ?= disp-xy
HORIZON_MS ?= 10 20
TRAIN_PRESETS ?= adamw paper
FOLDS ?= 3
STEPS ?= 40000
ADAMW_STEPS ?= $(shell echo $$(( $(STEPS) < 10000 ? $(STEPS) : 10000 )))
IMAGE_STEPS ?= $(shell echo $$(( $(STEPS) < 3000 ? $(STEPS) : 3000 )))
# Four minutes each on two cores, and as long to judge.
IMAGE_SEEDS ?= $(SEEDS)
# make force: models of so many seeds are judged on so many trajectories
FORCE ?= data/force
FORCE_SEEDS ?= 3
OTHERS ?= second soft-gel stiff-gel
JUDGED ?= 3
# make tracking: trajectories that rub edges over the gel, and presets of the tracker
TRACKING ?= data/tracking
EDGES ?= 50
PRESETS ?= unregularised paper official stable
# make labels: trajectories of each of the paper's twenty objects
LABELS ?= data/labels
EACH ?= 5
# make vibration: 100 s of each tone, and 10 s of each for so many seeds that draw everything anew
VIBRATION ?= data/vibration
VIBRATION_SEEDS ?= 20
# make data-rate
RATE ?= data/data-rate
TRAJECTORIES ?= 5
# make grasp-table: trials of each object by each controller, and of contact alone; which controllers
GRASPS ?= data/grasps
TRIALS ?= 10
ALONE ?= 5
CONTROLLERS ?= paper paper-reset load-proportional
REPORTS ?= reports
VENV := .venv
BIN := $(VENV)/bin
EVETAC := $(CURDIR)/$(BIN)/evetac
READY := $(VENV)/.ready

.DEFAULT_GOAL := help
.PHONY: help setup demo strips slip-data slip-models slip-images slip-table ship tracking labels vibration data-rate force grasp-table results film test test-all check bench clean

# `run` shows a command and runs it; whatever is made already is skipped, so that every target goes on where it was
# stopped. `keep NAME COMMAND` leaves an evaluation's JSON, table and picture in REPORTS, anew where its recipe changed.
RUN = set -e; shopt -s nullglob; run() { echo "+ evetac $$*"; $(EVETAC) $$* --quiet; }; \
	keep() { name=$$1; shift; mkdir -p $(abspath $(REPORTS)); kept=$(abspath $(REPORTS))/$$name; \
	echo "+ evetac $$* > $$kept.json, .txt, .png"; \
	$(EVETAC) $$* --out $$name.report.h5 --force --quiet --json > $$kept.json.part; mv $$kept.json.part $$kept.json; \
	COLUMNS=240 $(EVETAC) $$* --out $$name.report.h5 > $$kept.txt.part; mv $$kept.txt.part $$kept.txt; \
	if [ -e $$name.report.png ]; then cp $$name.report.png $$kept.png; fi; };

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

setup: $(READY)  ## make a virtual environment of its own in .venv

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[camera,convert,plot,dev]'
	@touch $@

# Trajectories to learn from, to choose threshold and checkpoint on, and to be judged on have seeds of their own.
demo: $(READY)  ## from touch to grasp on a simulated sensor, a few minutes; results in demo/ (SEED, JOBS, DEMO)
	@$(RUN) started=$$(date +%s.%N); mkdir -p $(DEMO); cd $(DEMO); \
	run record --object 3,6,8,9 --count 5 --seed $(SEED) --out learn --jobs $(JOBS); \
	run record --object 3,6,8,9 --seed $$(( $(SEED) + 500 )) --out choose --jobs $(JOBS); \
	run record --object 4,8,11 --count 3 --seed $$(( $(SEED) + 1000 )) --out unseen --jobs $(JOBS); \
	run track "*/*.recording.h5" --jobs $(JOBS); \
	run label "*/*.recording.h5" --after-ms 25 --jobs $(JOBS); \
	run featurize "*/*.recording.h5" --jobs $(JOBS); \
	run train "learn/*.features.h5" --validate choose --preset adam --epochs 30 --seed $(SEED) --out slip.model.h5; \
	run evaluate labels "unseen/*.labels.h5" --out labels.report.h5; \
	run evaluate tracking "unseen/*.tracks.h5" --out tracking.report.h5; \
	run evaluate slip "unseen/*.features.h5" --model slip.model.h5 --out slip.report.h5; \
	run grasp --object 11 --seed $(SEED) --model slip.model.h5 --lift-s 7 --balance-s 5 --out with-detector.recording.h5; \
	run grasp --object 11 --seed $(SEED) --controller none --lift-s 7 --balance-s 0 --out without-detector.recording.h5; \
	run evaluate grasp "with*-detector.recording.h5" --out grasp.report.h5; \
	$(CURDIR)/$(BIN)/python $(CURDIR)/scripts/demo_table.py $$started

slip-data: $(READY)  ## simulated slips to learn from and to be judged on, in data/slip (TRAIN, VALIDATE, TEST, SEED, JOBS)
	@$(RUN) mkdir -p $(SLIP); cd $(SLIP); \
	slips() { run record --scene slip --sensor $(SENSOR) --object $$2 --count $$3 --seed $$4 --out $$1 --jobs $(JOBS); \
	run label "$$1/*.recording.h5" --jobs $(JOBS); \
	run track "$$1/*.recording.h5" --preset $(TRACKER) --jobs $(JOBS); \
	run featurize "$$1/*.recording.h5" --images --jobs $(JOBS); }; \
	slips learn $(KNOWN) $(TRAIN) $(SEED); \
	slips choose $(KNOWN) $(VALIDATE) $$(( $(SEED) + 500 )); \
	slips known $(KNOWN) $(TEST) $$(( $(SEED) + 1000 )); \
	slips unseen $(UNSEEN) $(TEST) $$(( $(SEED) + 1500 )); \
	run label "learn/*.recording.h5" --method truth --out truth --jobs $(JOBS); \
	run featurize "learn/*.recording.h5" --tracks learn --labels truth --out truth --jobs $(JOBS)

LEARN = $(RUN) cd $(SLIP); learn() { from=$$1; folder=$$2; shift 2; run train "$$from/*.features.h5" $$* \
	--validate choose --seed $(SEED) --seeds $$seeds --out models/$$folder --jobs $(JOBS); };

slip-models: $(READY)  ## train slip detectors on what slip-data made (TRAIN_PRESETS, SEEDS, STEPS, FOLDS, MODELS, HORIZON_MS, JOBS)
	@$(LEARN) seeds=$(SEEDS); \
	for recipe in $(TRAIN_PRESETS); do steps=$(STEPS); models="$(MODELS)"; later="$(filter hist20 fast-slow,$(MODELS))"; \
	if [ $$recipe = adamw ]; then steps=$(ADAMW_STEPS); models="$$models $(OURS)"; later="$$later $(OURS)"; fi; \
	for model in $$models; do learn learn $$recipe --model $$model --preset $$recipe --max-steps $$steps; done; \
	for model in $$later; do for ahead in $(HORIZON_MS); do \
	learn learn $$recipe-ahead --model $$model --horizon-ms $$ahead --preset $$recipe --max-steps $$steps; done; done; done; \
	learn truth truth --model fast-slow --horizon-ms 10 --preset adamw --max-steps $(ADAMW_STEPS); \
	if [ $(FOLDS) != 0 ]; then \
	learn learn folds --model fast-slow --horizon-ms 10 --preset adamw --max-steps $(ADAMW_STEPS) --folds $(FOLDS); fi

# On a CPU the image baselines run on images summed over 6 x 6 px, for fewer steps, and beside them hist10 for as many.
slip-images: $(READY)  ## train the image baselines, the slowest part; IMAGE_MODELS= leaves them out (IMAGE_SEEDS, IMAGE_STEPS)
	@$(LEARN) seeds=$(SEEDS); learn learn images --model hist10 --preset adamw --max-steps $(IMAGE_STEPS); \
	seeds=$(IMAGE_SEEDS); for model in $(IMAGE_MODELS); do \
	learn learn images --model $$model --preset adamw --max-steps $(IMAGE_STEPS); done; \
	for model in $(filter hist10-img%,$(IMAGE_MODELS)); do for ahead in $(HORIZON_MS); do \
	learn learn images-ahead --model $$model --horizon-ms $$ahead --preset adamw --max-steps $(IMAGE_STEPS); done; done

slip-table: slip-models slip-images  ## ... and judge all of these on unseen slips: tables in reports/
	@$(RUN) cd $(SLIP); keep slip-training-objects evaluate slip "known/*.features.h5" --model \
	"models/paper/*.model.h5 models/adamw/*.model.h5 models/images/*.model.h5"; \
	unseen="--model models/*/hist20*.model.h5 models/*/fast-slow*.model.h5 \
	models/images*/hist10-img*.model.h5 models/*/disp-xy*.model.h5"; \
	keep slip-unseen-objects evaluate slip "unseen/*.features.h5 $$unseen"; \
	keep model-cost evaluate cost model "slip-unseen-objects.report.h5 $$unseen"

ship: slip-table  ## put the best fast-slow detector, 10 ms ahead, into the package, for grasp
	$(BIN)/python scripts/ship_model.py $(SLIP)/models/adamw-ahead/fast-slow-10ms-s*.model.h5 $(REPORTS)/slip-unseen-objects.json

tracking: $(READY)  ## presets of the tracker on edges, slip and shear, simulated: tables in reports/ (EDGES, PRESETS, SEED, JOBS)
	@$(RUN) mkdir -p $(TRACKING); cd $(TRACKING); \
	tracked() { name=$$1; shift; run record $$* --seed $(SEED) --out $$name --jobs $(JOBS); \
	for preset in $(PRESETS); do run track "$$name/*.recording.h5" --preset $$preset --out $$name/$$preset --jobs $(JOBS); done; \
	keep tracking-$$name evaluate tracking "$$name/*/*.tracks.h5" --recordings $$name; }; \
	tracked edge-cut --scene edge --count $(EDGES); \
	tracked edge-closed --scene edge --gel closed --count 5; \
	for gel in cut closed; do \
	tracked slip-$$gel --scene slip --gel $$gel --object 3,8,11,16,18; \
	tracked shear-$$gel --scene shear --gel $$gel; done

labels: $(READY)  ## slip labels against truth, all twenty objects, simulated: a table in reports/ (EACH, SEED, JOBS)
	@$(RUN) mkdir -p $(LABELS); cd $(LABELS); \
	run record --object 1-20 --count $(EACH) --seed $$(( $(SEED) + 300 )) --out . --jobs $(JOBS); \
	run label "*.recording.h5" --jobs $(JOBS); \
	keep labels evaluate labels "*.labels.h5"

vibration: $(READY)  ## which tone the gel feels, simulated: tables in reports/ (VIBRATION_SEEDS, SEED, JOBS)
	@$(RUN) mkdir -p $(VIBRATION); cd $(VIBRATION); \
	run record --scene vibration --seed $(SEED) --out . --jobs $(JOBS); \
	keep vibration evaluate vibration "vibration-*hz-s$(SEED)-000.recording.h5" --windows 10,2,1,0.25; \
	run record --scene vibration-randomized --count $(VIBRATION_SEEDS) --seed $(SEED) --out drawn --jobs $(JOBS); \
	keep vibration-randomized evaluate vibration "drawn/*hz-s$(SEED)-*.recording.h5" --windows 10,2,1,0.25

data-rate: $(READY)  ## bytes a second against an RGB sensor, simulated: a table in reports/ (TRAJECTORIES, SEED, JOBS)
	@$(RUN) mkdir -p $(RATE); cd $(RATE); \
	run record --scene data-rate --count $(TRAJECTORIES) --seed $(SEED) --out . --jobs $(JOBS); \
	keep data-rate evaluate data-rate "data-rate-*-s$(SEED)-*.recording.h5"

# The first trajectory to be judged on is pushed over every gel in the same way, so that only the gel differs.
force: $(READY)  ## shear force from dots in events and in frames, simulated: a table in reports/ (FORCE_SEEDS, JUDGED, OTHERS, SEED, JOBS)
	@$(RUN) mkdir -p $(FORCE); cd $(FORCE); \
	run record --scene shear --count 4 --seed $(SEED) --out learn --jobs $(JOBS); \
	run record --scene shear --count $(JUDGED) --seed $$(( $(SEED) + 500 )) --out unseen --jobs $(JOBS); \
	for other in $(OTHERS); do \
	run record --scene shear --sensor $$other --seed $$(( $(SEED) + 500 )) --out $$other; done; \
	run track "*/*.recording.h5" --preset stable --jobs $(JOBS); \
	run track-rgb "*/*.recording.h5" --jobs $(JOBS); \
	for each in $$(seq $(SEED) $$(( $(SEED) + $(FORCE_SEEDS) - 1 ))); do \
	run train-force "learn/*.tracks.h5" --seed $$each --out models/events-$$each.force-model.h5; \
	run train-force "learn/rgb/*.tracks.h5" --seed $$each --out models/frames-$$each.force-model.h5; done; \
	others=; for other in $(OTHERS); do others="$$others $$other/*.tracks.h5 $$other/rgb/*.tracks.h5"; done; \
	keep force evaluate force "unseen/*.tracks.h5 unseen/rgb/*.tracks.h5" $$others --model models --seed $(SEED)

# Objects of the paper's figure; higher gains where it used them (14 with both); weights, other sensor and closed gel.
grasp-table: $(READY)  ## lift and balance by feel, all controllers side by side, simulated: tables in reports/ (TRIALS, CONTROLLERS, ALONE, SEED, JOBS)
	@$(RUN) mkdir -p $(GRASPS); cd $(GRASPS); \
	grasped() { into=$$1; shift; run grasp $$* --seed $(SEED) --out $$into --jobs $(JOBS); }; \
	for controller in $(CONTROLLERS); do \
	gain=; if [ $$controller != load-proportional ]; then gain="--gain 2"; fi; \
	grasped $$controller --controller $$controller --object 10-18 --count $(TRIALS); \
	if [ -n "$$gain" ]; then grasped $$controller-higher --controller $$controller $$gain --object 14,19,20 --count $(TRIALS); \
	else grasped $$controller --controller $$controller --object 19,20 --count $(TRIALS); fi; \
	grasped $$controller-tests --controller $$controller --scene sideways --object 16 --count $(TRIALS); \
	grasped $$controller-tests --controller $$controller --scene drop-20g --object 16 --count $(TRIALS); \
	grasped $$controller-tests --controller $$controller $$gain --scene drop-100g --object 16 --count $(TRIALS); \
	for gel in cut closed; do \
	grasped $$controller-second-$$gel --controller $$controller --sensor second --gel $$gel --object 16,17 --count $$(( ($(TRIALS) + 1) / 2 )); \
	grasped $$controller-second-$$gel --controller $$controller $$gain --sensor second --gel $$gel --object 19,20 --count $$(( ($(TRIALS) + 1) / 2 )); \
	done; done; \
	grasped alone --controller none --object 10-20 --count $(ALONE) --balance-s 0; \
	for ticks in 4 8 16; do grasped fixed-$$ticks --controller fixed:$$ticks --object 11,18 --count $(ALONE); done; \
	keep grasps evaluate grasp $(foreach controller,$(CONTROLLERS),"$(controller)/*.recording.h5 $(controller)-higher/*.recording.h5") \
	"alone/*.recording.h5 fixed-*/*.recording.h5"; \
	keep grasp-robustness evaluate grasp $(foreach controller,$(CONTROLLERS),"$(controller)-tests/*.recording.h5 $(controller)-second-*/*.recording.h5")

results:  ## put the tables in reports/ into the README
	$(PYTHON) scripts/results.py $(REPORTS) README.md

strips: demo  ## a picture of every scene, in strips/: what is seen at telling moments, forces and slip (STRIPS, DEMO)
	@$(RUN) mkdir -p $(STRIPS); cd $(STRIPS); \
	for scene in slip data-rate shear press edge; do run record --scene $$scene --seed $(SEED) --out $$scene.recording.h5; done; \
	sed 's/^tone_s = .*/tone_s = 3.0/' $(CURDIR)/evetac_cli/data/scenes/vibration.toml > vibration.toml; \
	run record --scene vibration.toml --tone 200 --seed $(SEED) --out vibration.recording.h5; \
	for scene in lift sideways drop-20g drop-100g; do \
	run grasp --scene $$scene --object 16 --seed $(SEED) --model $(abspath $(DEMO))/slip.model.h5 --out $$scene.recording.h5; done; \
	$(CURDIR)/$(BIN)/python $(CURDIR)/scripts/strips.py *.recording.h5 --out .

# The film tells of the farthest slide that was caught: the recording it needs is one that has such a slide.
film: $(READY)  ## a short film of a catch, simulated: docs/catch.gif (STRIPS)
	@$(RUN) mkdir -p $(STRIPS); cd $(STRIPS); \
	run grasp --object 17 --seed 0 --lift-s 7 --balance-s 5 --out catch.recording.h5; \
	run track catch.recording.h5; \
	$(CURDIR)/$(BIN)/python $(CURDIR)/scripts/film.py catch.recording.h5 --out $(CURDIR)/docs/catch.gif

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
	rm -rf $(DEMO) $(STRIPS) dist .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
