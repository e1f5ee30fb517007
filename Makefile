# `make demo` and `make test` do all of their own set-up from a bare clone with Python >= 3.11.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.ONESHELL:
.PHONY: help setup demo test lint accuracy faults soak audit exporter lock oldest docs clean

VENV ?= .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PLACE := $(VENV)/.place
# An environment that lies elsewhere is somebody's own, or two checkouts': it is neither cleared nor removed.
ELSEWHERE := $(filter /% ../%,$(VENV))

help: ## show this list
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /  make \1\t/' | expand -t 20

setup: $(STAMP) ## make the environment in .venv

# Commands and the package's place are written into an environment as paths: moved, it is of no use.
ifneq ($(shell cat $(PLACE) 2>/dev/null),$(CURDIR))
.PHONY: $(STAMP)
endif

# The interpreter is tried, not just found: a name on the path may be a shim without a version behind it.
$(STAMP): requirements.lock pyproject.toml setup.py tools/find_python.sh
	@python="$$(tools/find_python.sh)"
	# An environment that was interrupted half way, or whose Python has gone, is made anew, and one that moved
	# with its checkout. One that lies elsewhere is installed into.
	was="$$(cat $(PLACE) 2>/dev/null || true)"
	if ! $(BIN)/python -m pip --version >/dev/null 2>&1 ||
	    [[ -n "$$was" && "$$was" != "$(CURDIR)" && -z "$(ELSEWHERE)" ]]; then
	    echo "making $(VENV) with $$python"
	    "$$python" -m venv --clear $(VENV)
	fi
	echo "$(CURDIR)" > $(PLACE)
	echo "installing the locked dependencies into $(VENV)"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $(STAMP)

demo: $(STAMP) ## see metric poses arrive: a simulated walk through the whole daemon
	$(BIN)/prism-edge demo --out build/demo $(DEMO_ARGS)

test: lint ## everything that must hold: ruff, mypy, tests (without the slow ones)
	$(BIN)/python -m pytest -m "not slow" --numprocesses 2 $(PYTEST_ARGS)

lint: $(STAMP) ## ruff and mypy
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy

accuracy: $(STAMP) ## recorded sequences beside the checkout: the slow tests, and every figure against its bar
	$(BIN)/python -m pytest -m slow $(PYTEST_ARGS)
	$(BIN)/python tools/accuracy.py $(ACCURACY_ARGS)

faults: $(STAMP) ## random faults on the running service, malformed inputs, and more than one machine (docs/FAULTS.md)
	$(BIN)/python tools/faults.py $(FAULTS_ARGS)
	$(BIN)/python tools/fuzz.py
	$(BIN)/python tools/fleet_trial.py

soak: $(STAMP) ## an hour at 30 Hz: memory, latency and the map stay where they are
	$(BIN)/python tools/soak.py $(SOAK_ARGS)

audit: $(STAMP) ## known vulnerabilities of the locked dependencies; needs a network
	tools/audit.sh $(BIN)

exporter: ## make the environment of tools/export_da3 in .venv-export (PyTorch; the daemon needs none)
	tools/export_da3/setup.sh

docs: $(STAMP) ## write the table of docs/CONFIGURATION.md anew
	$(BIN)/python tools/document_config.py

lock: $(STAMP) ## resolve the dependencies anew into requirements.lock and requirements-extras.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pip-tools
	tools/lock.sh $(BIN)

oldest: ## the tests with the oldest releases that pyproject.toml allows, in .venv-oldest
	tools/oldest.sh $(PYTEST_ARGS)

clean: ## remove the environment and what tools cache
	rm -rf $(if $(ELSEWHERE),,$(VENV)) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
