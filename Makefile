# The experiments, the tests and the checks. `make help` lists the targets; each sets up first what it needs.
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
PYTHON ?= python3
# Of the experiments: files worked on at the same time; SMALL=1 for sizes of minutes; SIZES="each=1 seed=7" for others,
# of which `make experiments` prints a list.
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
SMALL ?=
SIZES ?=
# Of bench: a revision, or the folder of another checkout, to compare with.
BASE ?=
# Of profile: a file for its figures as JSON.
COSTS ?=
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
ALL := $(VENV)/.ready-to-develop
# Extras of the commands of README and of the first hour; the others come with setup-all, or one by one when needed.
USED := plot
EVERY := camera,cluster,convert,log,plot,robot,view,dev,docs
# Where pip looks beside its own index, for torch without CUDA: https://download.pytorch.org/whl/cpu, or a folder.
TORCH_INDEX ?=
LOWEST := .venv-lowest
LEROBOT := .venv-lerobot
# Of lerobot: its newest version that is tested wants Python 3.12.
LEROBOT_PYTHON ?= python3.12
REPRODUCE = $(BIN)/python scripts/reproduce.py --jobs $(JOBS) $(if $(SMALL),--small) $(SIZES:%=--size %)

# Installs, and says of each larger package that it comes: pip says either nothing for minutes, or hundreds of lines.
INSTALL = $(BIN)/python -m pip install --no-compile --disable-pip-version-check --progress-bar off \
	--constraint constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) --editable
SAYING = awk '/(Downloading|Using cached) .*MB\)/ {sub(/^ +/, ""); print "  " $$0} \
	/^Installing collected packages/ {print "  unpacking " NF - 3 " packages"} {fflush()}' >&2

# Modules are kept compiled, whatever the environment says: the tests start hundreds of processes.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup setup-all experiments demo strips slip-data slip-models slip-images slip-table true-slip-share \
	paper-recipe ship tracking vibration data-rate force grasp-table part-effects \
	blind-identification force-sensors touch-cost mujoco-grasps lift-baseline results film test test-all test-lowest lerobot check lint types docs bench profile clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 22

setup: $(READY)  ## make a virtual environment in .venv for README's commands, and compile them (TORCH_INDEX)

setup-all: $(ALL)  ## ... with every extra, and what tests, checks and documentation use

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	@echo 'installing evetac and what it uses, [$(USED)], into $(VENV)'
	@$(INSTALL) '.[$(USED)]' | $(SAYING)
	$(BIN)/evetac doctor --compile
	@touch $@

$(ALL): $(READY)
	@echo 'installing the other extras, and what tests, checks and documentation use, [$(EVERY)], into $(VENV)'
	@$(INSTALL) '.[$(EVERY)]' | $(SAYING)
	@touch $@

experiments: $(READY)  ## list the experiments with their sizes
	@$(REPRODUCE) --list

demo: $(READY)  ## from touch to grasp on a simulated sensor, one to four minutes; results in demo/ (SIZES, JOBS)
	@$(REPRODUCE) --only $@

slip-data: $(READY)  ## simulated slips to learn from and to be judged on, in data/slip (SMALL, SIZES, JOBS, as all that follow)
	@$(REPRODUCE) --only $@

slip-models: $(READY)  ## ... train slip detectors on them
	@$(REPRODUCE) --only $@

slip-table: $(READY)  ## ... and judge these on unseen slips
	@$(REPRODUCE) --only $@

slip-images: $(READY)  ## ... train and judge those that see images, the slowest part
	@$(REPRODUCE) --only $@

true-slip-share: $(READY)  ## ... what the true share of the contact that slips is worth to a training
	@$(REPRODUCE) --only $@

paper-recipe: $(READY)  ## the paper's recipe at its size, and one thing of it changed at a time
	@$(REPRODUCE) --only $@

ship: $(READY)  ## train the slip detector on many motions, sensors and objects, and put it into the package
	@$(REPRODUCE) --only $@

tracking: $(READY)  ## presets of the tracker on edges, slip and shear
	@$(REPRODUCE) --only $@

vibration: $(READY)  ## at which frequency the gel vibrates
	@$(REPRODUCE) --only $@

data-rate: $(READY)  ## bytes a second against an RGB sensor
	@$(REPRODUCE) --only $@

force: $(READY)  ## shear force from dots in events and in frames
	@$(REPRODUCE) --only $@

grasp-table: $(READY)  ## lift and balance by feel, all controllers side by side
	@$(REPRODUCE) --only $@

part-effects: $(READY)  ## what each part of a sensor or a scene does to each stage
	@$(REPRODUCE) --only $@

blind-identification: $(READY)  ## whether sensors that identify has never seen are found again
	@$(REPRODUCE) --only $@

force-sensors: $(READY)  ## ... and forces by touch maps of these sensors
	@$(REPRODUCE) --only $@

touch-cost: $(READY)  ## what a step of the touch sensor costs
	@$(REPRODUCE) --only $@

mujoco-grasps: $(ALL)  ## grasps in MuJoCo with our touch
	@$(REPRODUCE) --only $@

lift-baseline: $(ALL)  ## a grip law found by CMA-ES against fixed grips
	@$(REPRODUCE) --only $@

strips: $(READY)  ## a picture of every scene, in strips/: events, forces and slip
	@$(REPRODUCE) --only $@

film: $(READY)  ## a short film of a catch: docs/catch.gif
	@$(REPRODUCE) --only $@
	cp $(if $(SMALL),small/)film/catch.gif docs/catch.gif

results: $(READY)  ## write the tables in docs/results/ into README and docs
	$(BIN)/python scripts/results.py

# Threads of BLAS that wait for each other's cores make small matrices ten times as dear.
ONE_THREAD := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

test: $(ALL)  ## the test suite; first installs what it needs, if anything is missing
	$(ONE_THREAD) $(BIN)/python -m pytest --numprocesses 3 --dist loadfile -m 'not slow'

test-all: $(ALL)  ## the test suite with its longer cases
	$(ONE_THREAD) $(BIN)/python -m pytest --numprocesses 2 --dist loadfile

test-lowest: $(LOWEST)/.ready  ## the test suite with the lowest versions that pyproject.toml allows, in .venv-lowest
	NUMBA_CACHE_DIR=$(CURDIR)/$(LOWEST)/numba $(LOWEST)/bin/python -m pytest --numprocesses 2 --dist loadfile -m 'not slow'

$(LOWEST)/.ready: pyproject.toml scripts/lowest.py
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python scripts/lowest.py > $(LOWEST)/lowest.txt
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(LOWEST)/lowest.txt --editable '.[camera,cluster,convert,log,plot,robot,dev]'
	@touch $@

lerobot:  ## environments of their own for LeRobot 0.6.1 (LEROBOT_PYTHON) and 0.4.4, gigabytes, for slow tests
	$(LEROBOT_PYTHON) -m venv --clear $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet --disable-pip-version-check 'lerobot[training,core-scripts]==0.6.1' \
		torch==2.7.1 torchvision==0.22.1 'torchcodec<0.6' 'opencv-contrib-python-headless<4.14' \
		--editable . --editable examples/lerobot_camera_evetac
	$(PYTHON) -m venv --clear $(LEROBOT)-0.4.4
	$(LEROBOT)-0.4.4/bin/python -m pip install --quiet --disable-pip-version-check lerobot==0.4.4 torch==2.7.1 torchvision==0.22.1

check: $(ALL)  ## ruff, mypy --strict and the documentation, side by side
	@$(MAKE) --no-print-directory --jobs 3 --output-sync=target lint types docs

lint: $(ALL)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(ALL)
	$(BIN)/mypy

docs: $(ALL)  ## the documentation: site/index.html, with every page of the reference made from the code
	$(BIN)/python scripts/docs/pages.py
	$(BIN)/zensical build --clean --strict
	$(BIN)/python scripts/docs/check_site.py
	@echo 'open site/index.html; its search needs a server: python3 -m http.server --bind 127.0.0.1 --directory site'

bench: $(READY)  ## run times of the kernels, as ratios in one run: to real time, to other ways, to a commit (BASE)
	$(BIN)/python scripts/bench.py $(if $(BASE),--against $(BASE))

profile: $(READY)  ## what each stage costs: processor time, memory and bytes per trial, start-up apart (COSTS, for JSON)
	$(BIN)/python scripts/stage_costs.py $(if $(COSTS),-o $(COSTS))

clean:  ## remove what demo, tests and builds left; the environment stays
	rm -rf demo strips film small dist site docs/reference .cache .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
