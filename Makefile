# `make demo` and `make test` set up .venv when it is missing or out of date. PYTHON: 3.11 or later.
# PIP_ARGS: more options for pip, such as an index that offers torch without CUDA.

PYTHON ?= python3
PIP_ARGS ?=
BIN := .venv/bin
READY := .venv/.ready
PIP := $(BIN)/python -m pip install --disable-pip-version-check -q $(PIP_ARGS) -c constraints.txt

.PHONY: demo test fuzz faults bench studies leaderboard docs wheel-check clean
.DEFAULT_GOAL := test

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed, $(PYTHON) is %d.%d: make PYTHON=python3.11" % sys.version_info[:2])'
	@echo "setting up .venv, a few minutes"
	$(PYTHON) -m venv .venv
	$(PIP) torch # first and alone, so that a build without CUDA is taken where one is offered
	$(PIP) -e '.[dev]'
	@touch $@

# a real robot: pendulum or so101
ROBOT ?= pendulum

demo: $(READY)
	$(BIN)/python examples/demo.py $(ROBOT)

test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -c "import arviz" # writes its note of the day, which two processes at once can not
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n logical --dist loadfile # a process for each core, one thread each

# changed files and odd options: 100,000 cases; FUZZ=--target for some, --seed N for one that failed
fuzz: $(READY)
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz.run $(FUZZ)

# commands that are killed, interrupted, left without disk or log: ten kills of each; FAULTS=--command for some
faults: $(READY)
	$(BIN)/python -m tests.fuzz.faults $(FAULTS)

bench: $(READY)
	$(BIN)/python tests/bench/bench.py

studies: $(patsubst examples/studies/%.py,study-%,$(wildcard examples/studies/[a-z]*.py))

study-%: $(READY)
	$(BIN)/python examples/studies/$*.py

# every entry of the leaderboard, two at a time, and the page; the same command goes on where it was interrupted
LEADERBOARD ?= runs/leaderboard
OWN := prior laplace calibrate npe bayessim cem regression
FOREIGN := $(patsubst examples/leaderboard/%.py,%,$(wildcard examples/leaderboard/[a-z]*.py))

leaderboard: $(READY)
	OMP_NUM_THREADS=1 $(MAKE) -j2 $(OWN:%=own-entry-%) $(FOREIGN:%=foreign-entry-%)
	$(BIN)/sipe leaderboard report $(addprefix $(LEADERBOARD)/,$(OWN) $(FOREIGN)) --out $(LEADERBOARD)/page

own-entry-%: $(READY)
	$(BIN)/sipe leaderboard run $* --out $(LEADERBOARD)/$*

foreign-entry-%: $(READY)
	$(BIN)/python examples/leaderboard/$*.py --out $(LEADERBOARD)/$*

# the site, into docs/_build, with warnings as errors
docs: $(READY)
	$(BIN)/python docs/generate.py
	$(PIP) -e '.[docs]'
	$(BIN)/python -m sphinx -q -W --keep-going docs docs/_build

# sdist -> wheel, and what the wheel holds
wheel-check: $(READY)
	.ci/run wheel

clean:
	rm -rf .venv build dist docs/_build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
