# make demo    from nothing to a report: environment, data, training, tests, closed loop, page
# make test    lint, format, types and the fast tests
# make test-all   the slow tests too: trainings, studies, simulated robots
# make docs    the documentation as a site that opens from disk: build/site/index.html
# make bench   times on this machine, and one table of ours beside its peers, where `make peers` was
# make bench-quick   a few minutes: that all of the table runs; its figures are worth nothing
# make peers   what the table compares with (torch, crocoddyl, mpc), in an environment of its own
# make dist    wheel and source archive, dist/, ready for an index; needs no network
# make clean   remove what was made here (the environment too)
#
# make demo PYTHON=python3.12   another interpreter, 3.11 or newer

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PEERS := .venv-peers
PACKAGE := $(VENV)/.installed
DEVELOPMENT := $(VENV)/.installed-dev
DOCUMENTATION := $(VENV)/.installed-docs
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet --quiet
DEMO := demo
DATA := $(DEMO)/release.h5
RUN := $(DEMO)/run
TRAINED := $(DEMO)/.trained
REPORT := report/index.html

.PHONY: help demo test test-all docs bench bench-quick peers dist clean
.DELETE_ON_ERROR:

help:
	@sed -n 's/^# \{0,1\}//p' Makefile | sed '/^$$/q'

demo: $(REPORT)
	@echo
	@echo "The report is at $(abspath $(REPORT)); open it in a browser."

# Tests on fresh scenes: what the trained model infers on release, where geometry does not tell what
# is held, beside the shipped model on pickup, where it does; and control of pickup, past 0 and 10
# distractors. A second training, or tests on twice the scenes, would take a minute each.
$(REPORT): $(TRAINED)
	@echo "== testing on fresh scenes, beside the model of pickup that ships with the package"
	@mkdir -p $(@D)
	@$(BIN)/contactgraph report pickup --quick --test-runs 10 --episodes 10 \
		--beside $(RUN) release --out $@

# A stamp, because the model's file is there from the first checkpoint on.
$(TRAINED): $(DATA)
	@echo "== training on release"
	@rm -rf $(RUN)
	@$(BIN)/contactgraph train $(DATA) --out $(RUN)
	@touch $@

$(DATA): | $(PACKAGE)
	@echo "== recording 40 runs of release"
	@mkdir -p $(@D)
	@$(BIN)/contactgraph collect release --episodes 40 --seed 0 --out $@

test: $(DEVELOPMENT)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest $(PARALLEL) -m "not slow and not realtime"

# These tests run with XLA's defaults, as users do; tests/conftest.py sets flags for the fast tests.
# Tests that measure milliseconds run alone.
test-all: test
	XLA_FLAGS= $(BIN)/pytest $(PARALLEL) -m "slow and not realtime"
	XLA_FLAGS= $(BIN)/pytest -m realtime

# The tests of a file share compiled programs, so one process runs them all.
PARALLEL = -n 2 --dist loadfile

docs: $(DOCUMENTATION)
	@$(BIN)/python docs/site_pages.py
	@$(BIN)/zensical build
	@$(BIN)/python docs/check_site.py

bench: $(PACKAGE)
	$(BIN)/python benchmarks/training_time.py
	$(BIN)/python benchmarks/training_throughput.py
	$(BIN)/python benchmarks/training_memory.py
	$(BIN)/python benchmarks/model_at_scale.py
	$(BIN)/python benchmarks/batched_rollouts.py
	$(BIN)/python benchmarks/batched_planning.py
	$(BIN)/python benchmarks/control_tick.py
	$(BIN)/python benchmarks/robot_loop.py
	$(BIN)/python benchmarks/tag_pose.py
	$(COMPARE) --out results/performance

bench-quick: $(PACKAGE)
	$(COMPARE) --quick

# With the peers where they are installed; else the table says which are missing.
COMPARE = $(if $(wildcard $(PEERS)/.installed),$(PEERS),$(VENV))/bin/python benchmarks/table.py

peers: $(PEERS)/.installed

# What an earlier build has left would get into the wheel.
dist: $(DEVELOPMENT)
	rm -rf dist build/lib build/bdist.*
	$(BIN)/python -m build --no-isolation

clean:
	rm -rf $(VENV) $(PEERS) $(DEMO) report build dist src/contactgraph.egg-info
	rm -rf .cache .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests examples benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

# Installed in place, so only a change of what is required calls for installing again.
$(DEVELOPMENT): pyproject.toml | $(BIN)/python
	@echo "== installing, with what development needs"
	@$(PIP) install -e '.[dev]'
	@touch $(PACKAGE) $(DOCUMENTATION) $@

$(DOCUMENTATION): pyproject.toml | $(BIN)/python
	@echo "== installing, with what the site needs"
	@$(PIP) install -e '.[docs]'
	@touch $(PACKAGE) $@

$(PACKAGE): pyproject.toml | $(BIN)/python
	@echo "== installing"
	@$(PIP) install -e .
	@touch $@

# mpc asks for numpy below 2, but runs with newer ones: hence --no-deps. Where pip would choose a
# torch for graphics cards, gigabytes large, name another: make peers TORCH=torch==2.13.0+cpu
TORCH ?= torch
$(PEERS)/.installed: pyproject.toml benchmarks/requirements-peers.txt
	@echo "== making $(PEERS): this package, torch, crocoddyl and mpc"
	@$(PYTHON) -m venv $(PEERS)
	@$(PEERS)/bin/python -m pip --disable-pip-version-check --quiet install -e . '$(TORCH)' \
		'crocoddyl>=3.2'
	@$(PEERS)/bin/python -m pip --disable-pip-version-check --quiet install --no-deps \
		-r benchmarks/requirements-peers.txt
	@echo "== building the pendulum for crocoddyl, where there is a compiler of C++"
	@-$(PEERS)/bin/python benchmarks/build_pendulum.py
	@touch $@

$(BIN)/python:
	@command -v $(PYTHON) > /dev/null || { \
		echo "$(PYTHON) was not found; name one: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "Python 3.11 or newer is needed, but $(PYTHON) is $$($(PYTHON) -V 2>&1);" \
			"name another: make PYTHON=python3.12" >&2; exit 1; }
	@echo "== making $(VENV) with $(PYTHON)"
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "$(PYTHON) cannot make environments; on Debian or Ubuntu: apt install python3-venv" >&2; \
		exit 1; }
