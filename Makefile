# `make help` lists the targets. Everything that needs set-up does it first.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup demo test prove fuzz mutation coverage docs lint wheel bench soak faults kills crashes clean

help: ## list the targets
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /  make \1\t/' | expand -t 16

setup: ## make .venv and build the interfaces; seconds when nothing changed
	@tools/setup.sh

demo: setup ## plan, measure and identify a simulated KUKA KR-270 over ROS 2
	@. ./env.sh && python -m calib_planner.ros.demo

test: setup ## run every test, in one process more than there are cores (PYTEST='-k plan' for some)
	@. ./env.sh && unset PYTHONDONTWRITEBYTECODE && OMP_NUM_THREADS=1 python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder $(PYTEST)

prove: setup ## every test with all its seeds and turns, of which make test takes a sample; then fuzz
	@CALIB_PLANNER_PROVE=1 $(MAKE) test
	@$(MAKE) fuzz

FUZZ_SECONDS ?= 600
fuzz: setup ## fuzz every reader and message conversion, ten minutes each (FUZZ='urdf plan' for some, '--total 30' for all in turn)
	@. ./env.sh && if ! python -c 'import atheris' 2>/dev/null; then \
	  echo "make fuzz: installing atheris into .venv" && \
	  python -m pip install --quiet --disable-pip-version-check -r requirements/fuzz.txt; fi && \
	  python test/fuzz/fuzz.py --seconds $(FUZZ_SECONDS) $(FUZZ)

mutation: setup ## mutants of formulas that no test catches; all take hours (MUTATION='--sample 20'; JSON to results/)
	@. ./env.sh && OMP_NUM_THREADS=1 python tools/mutation $(MUTATION)

coverage: setup ## share of the core's branches that tests take: build/coverage/index.html (a quarter of an hour)
	@. ./env.sh && OMP_NUM_THREADS=1 python tools/core_coverage.py $(COVERAGE)

docs: setup ## make the documentation: build/docs/index.html (warnings are errors; reference pages from the code)
	@. ./env.sh && python tools/reference && \
	  python -m sphinx -q -W --keep-going -b html -d build/docs/.doctrees docs build/docs && \
	  echo "make docs: build/docs/index.html"

lint: setup ## ruff and mypy
	@. ./env.sh && ruff check . && ruff format --check . && mypy

wheel: ## build sdist and wheel; install and use them without ROS in every Python 3.10 … 3.13 that is there
	@tools/wheel.sh

bench: setup ## peers, bounds, measured robots: docs/benchmarks.md with its pictures (half an hour; JSON to results/)
	@. ./env.sh && OMP_NUM_THREADS=1 python bench/page.py --run

soak: setup ## the identifier at 1 kHz for 10 minutes: none lost, memory flat (SOAK='--minutes 2'; JSON to results/)
	@mkdir -p results; . ./env.sh && python bench/soak.py $(SOAK) > results/soak.json

faults: setup ## every fault × 20 seeds through the nodes, simulated clock: a quarter of an hour (FAULTS='--seeds 2'; JSON to results/)
	@mkdir -p results; . ./env.sh && OMP_NUM_THREADS=1 python bench/faults_nodes.py $(FAULTS) > results/faults_nodes.json

kills: setup ## the identifier killed with -9 at 1 000 random instants: a quarter of an hour (KILLS='--count 20'; JSON to results/)
	@mkdir -p results; . ./env.sh && OMP_NUM_THREADS=1 python bench/kills.py $(KILLS) > results/kills.json

crashes: setup ## writers killed at every system call, full disks, power cuts: minutes (CRASHES='--every 10'; JSON to results/)
	@mkdir -p results; . ./env.sh && OMP_NUM_THREADS=1 python bench/crashes.py $(CRASHES) > results/crashes.json

clean: ## remove what was made: .venv, build, install, log, caches
	rm -rf .venv build install log .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
