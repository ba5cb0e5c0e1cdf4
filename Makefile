# Experiments, tests and checks. `make help` lists the targets; each target first sets up its environment.
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
PYTHON ?= python3
# For experiments: JOBS, the number of files processed in parallel; SMALL=1 for sizes that take minutes;
# SIZES="each=1 seed=7" for other sizes. `make experiments` lists the sizes.
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
SMALL ?=
SIZES ?=
# For benchmark: small or full.
SIZE ?= small
# For bench: a revision, or the folder of another checkout, to compare with.
BASE ?=
# For profile: a file for its figures as JSON.
COSTS ?=
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
ALL := $(VENV)/.ready-to-develop
KERNELS := $(VENV)/.compiled
# Extras for the commands of README and the first hour; setup-all installs the others.
USED := plot,convert
EVERY := camera,cluster,convert,plot,robot,dev,docs
# Additional pip index or folder, for torch without CUDA: https://download.pytorch.org/whl/cpu
TORCH_INDEX ?=
# UV=1 installs with uv, in half the time. Of the settings of pip, uv gets PIP_INDEX_URL and PIP_FIND_LINKS alone.
UV ?=
LOWEST := .venv-lowest
LEROBOT := .venv-lerobot
# For lerobot: the newest tested version of LeRobot requires Python 3.12.
LEROBOT_PYTHON ?= python3.12
REPRODUCE = $(BIN)/python scripts/reproduce/run.py --jobs $(JOBS) $(if $(SMALL),--small) $(SIZES:%=--size %)

# Installs packages and prints a line for each large one. pip itself prints nothing for minutes, or hundreds of lines.
PIP = $(BIN)/python -m pip install --no-compile --disable-pip-version-check --progress-bar off
INSTALLER = $(if $(UV),$(PIP) --quiet uv && $(BIN)/uv pip install --quiet --python $(BIN)/python \
	--index-strategy unsafe-best-match $(PIP_INDEX_URL:%=--index-url %) $(PIP_FIND_LINKS:%=--find-links %),$(PIP))
INSTALL = $(INSTALLER) --constraint constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) --editable
SAYING = awk '/(Downloading|Using cached) .*MB\)/ {sub(/^ +/, ""); print "  " $$0} \
	/^Installing collected packages/ {print "  unpacking " NF - 3 " packages"} {fflush()}' >&2

# Always keep compiled modules, because the tests start hundreds of processes.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup setup-all experiments demo strips paper-recipe image-networks \
	ship tracking vibration data-rate force grasp-table part-effects \
	blind-identification force-sensors touch-cost mujoco-grasps lift-baseline results film test test-alone test-all test-lowest lerobot check lint types docs bench archive benchmark profile clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 22

setup: $(KERNELS)  ## make a virtual environment in .venv for README's commands, and compile the kernels (TORCH_INDEX)

setup-all: $(ALL)  ## ... with all extras and all packages for tests, checks and documentation
	@$(COMPILE)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	@echo 'installing evetac with the extra [$(USED)] into $(VENV)'
	@$(INSTALL) '.[$(USED)]' | $(SAYING)
	@touch $@

# What needs all extras compiles in its recipe, since nothing may be installed meanwhile.
COMPILE = test $(KERNELS) -nt $(READY) || { $(BIN)/evetac doctor compile && touch $(KERNELS); }

$(KERNELS): $(READY)
	@$(COMPILE)

$(ALL): $(READY)
	@echo 'installing all extras and the packages for tests, checks and documentation, [$(EVERY)], into $(VENV)'
	@$(INSTALL) '.[$(EVERY)]' | $(SAYING)
	@touch $@

experiments: $(KERNELS)  ## list the experiments with their sizes
	@$(REPRODUCE) --list

demo: $(KERNELS)  ## all steps from touch to grasp on a simulated sensor, in one to four minutes; results in demo/ (SIZES, JOBS)
	@$(REPRODUCE) --only $@

paper-recipe: $(KERNELS)  ## train and evaluate slip detectors by the paper's recipe
	@$(REPRODUCE) --only $@

image-networks: $(KERNELS)  ## train and evaluate slip detectors on small event images
	@$(REPRODUCE) --only $@

ship: $(KERNELS)  ## train the pretrained slip detector on many motions, sensors and objects, and put it into the package
	@$(REPRODUCE) --only $@

tracking: $(KERNELS)  ## compare tracker presets on edges, slip and shear
	@$(REPRODUCE) --only $@

vibration: $(KERNELS)  ## measure the vibration frequency of the gel
	@$(REPRODUCE) --only $@

data-rate: $(KERNELS)  ## compare bytes per second with an RGB sensor
	@$(REPRODUCE) --only $@

force: $(KERNELS)  ## estimate shear force from dots in events and in frames
	@$(REPRODUCE) --only $@

grasp-table: $(KERNELS)  ## compare all controllers in lifting and balancing by feel
	@$(REPRODUCE) --only $@

part-effects: $(KERNELS)  ## measure the effect of each part of a sensor or a scene on each stage
	@$(REPRODUCE) --only $@

blind-identification: $(KERNELS)  ## test whether identify recovers unseen sensors
	@$(REPRODUCE) --only $@

force-sensors: $(KERNELS)  ## ... evaluate forces from touch maps of these sensors
	@$(REPRODUCE) --only $@

touch-cost: $(KERNELS)  ## measure the cost of a step of the touch sensor
	@$(REPRODUCE) --only $@

mujoco-grasps: $(ALL)  ## grasp in MuJoCo with evetac's touch sensor
	@$(REPRODUCE) --only $@

lift-baseline: $(ALL)  ## compare a grip law found by CMA-ES with fixed grips
	@$(REPRODUCE) --only $@

strips: $(KERNELS)  ## draw every scene, in strips/: events, forces and slip
	@$(REPRODUCE) --only $@

film: $(KERNELS)  ## make the short film of a catch, docs/catch.gif
	@$(REPRODUCE) --only $@
	cp $(if $(SMALL),small/)film/catch.gif docs/catch.gif

results: $(KERNELS)  ## write the tables in docs/results/ into README and docs
	$(BIN)/python scripts/paper/rows.py
	$(BIN)/python scripts/reproduce/results.py

# With several BLAS threads that wait for each other's cores, small matrices take ten times as long.
ONE_THREAD := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 MKL_NUM_THREADS=1

test: $(ALL)  ## run the test suite; installs missing packages first
	@$(COMPILE)
	$(ONE_THREAD) $(BIN)/python -m pytest --numprocesses 3 --dist loadfile -m 'not slow'

test-alone: $(ALL)  ## run the tests that want files from outside the repository, without these
	EVETAC_OUTSIDE_FILES=/nonexistent $(BIN)/python -m pytest --numprocesses 0 -m 'outside and not slow' \
		$$(grep -rlw --include='test_*.py' outside_file tests)

test-all: $(ALL)  ## run the test suite with its longer cases
	@$(COMPILE)
	$(ONE_THREAD) $(BIN)/python -m pytest --numprocesses 2 --dist loadfile

test-lowest: $(LOWEST)/.ready  ## run the test suite with the lowest versions that pyproject.toml allows, in .venv-lowest
	NUMBA_CACHE_DIR=$(CURDIR)/$(LOWEST)/numba $(LOWEST)/bin/python -m pytest --numprocesses 2 --dist loadfile -m 'not slow'

$(LOWEST)/.ready: pyproject.toml scripts/lowest.py
	$(PYTHON) -m venv --clear $(LOWEST)
	$(LOWEST)/bin/python scripts/lowest.py > $(LOWEST)/lowest.txt
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(LOWEST)/lowest.txt --editable '.[camera,cluster,convert,plot,robot,dev]'
	@touch $@

lerobot:  ## make environments with LeRobot 0.6.1 (LEROBOT_PYTHON) and 0.4.4 for slow tests (gigabytes)
	$(LEROBOT_PYTHON) -m venv --clear $(LEROBOT)
	$(LEROBOT)/bin/python -m pip install --quiet --disable-pip-version-check 'lerobot[training,core-scripts]==0.6.1' \
		torch==2.7.1 torchvision==0.22.1 'torchcodec<0.6' 'opencv-contrib-python-headless<4.14' \
		--editable . --editable examples/lerobot_camera_evetac
	$(PYTHON) -m venv --clear $(LEROBOT)-0.4.4
	$(LEROBOT)-0.4.4/bin/python -m pip install --quiet --disable-pip-version-check lerobot==0.4.4 torch==2.7.1 torchvision==0.22.1

check: $(ALL)  ## run ruff, check_citation.py, mypy --strict and the documentation build in parallel
	@$(MAKE) --no-print-directory --jobs 3 --output-sync=target lint types docs

lint: $(ALL)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python scripts/docs/check_citation.py

types: $(ALL)
	$(BIN)/mypy

docs: $(ALL)  ## build the documentation, site/index.html, with the reference pages made from the code
	$(BIN)/python scripts/docs/pages.py
	$(BIN)/zensical build --clean --strict
	$(BIN)/python scripts/docs/check_site.py
	@echo 'open site/index.html; its search needs a server: python3 -m http.server --bind 127.0.0.1 --directory site'

archive: $(READY)  ## pack tables, models and rows of the published figures, with checksums, for a data repository
	@$(BIN)/python scripts/ship/archive.py

benchmark: $(KERNELS)  ## make evetac-bench, the benchmark that can be given away, in bench-small/ (SIZE=full, JOBS)
	$(BIN)/python scripts/benchmark/make.py make --size $(SIZE) --out bench-$(SIZE) --jobs $(JOBS)

bench: $(KERNELS)  ## compare kernel run times in one run: with real time, other methods, or a commit (BASE)
	$(BIN)/python scripts/speed/bench.py $(if $(BASE),--against $(BASE))

profile: $(KERNELS)  ## measure each stage: processor time, memory and bytes per trial, and start-up (COSTS, for JSON)
	$(BIN)/python scripts/speed/stage_costs.py $(if $(COSTS),-o $(COSTS))

clean:  ## remove files from demo, tests and builds; keep the environment
	rm -rf demo strips film small dist site .cache .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
