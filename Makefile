# make demo | test | test-deploy | lint | format | ci | clean. Each does all the set-up it needs, once.

# The first interpreter of a tested version; `make PYTHON=/path/to/python3.x ...` takes another.
CANDIDATES := python3 python3.13 python3.12 python3.11 python
PYTHON ?= $(shell for p in $(CANDIDATES); do \
	if $$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; \
	then echo $$p; break; fi; done)

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALL := $(PIP) install -q --no-compile -c constraints.txt # modules compile when first imported
TORCH := $(shell grep '^torch==' constraints.txt)
EXTRAS := warp,train,demo,deploy,sdk,ray,dev

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-deploy lint format ci clean
.DELETE_ON_ERROR:

help: ## List the commands
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "make %-11s %s\n", $$1, $$2}' $(firstword $(MAKEFILE_LIST))

setup: $(READY) ## Virtual environment with the tested set of packages

demo: $(READY) ## The Go2 plans its way from hind legs to a handstand, three seeds
	$(BIN)/python tools/flip.py --seeds 3

test: $(READY) ## All tests
	$(BIN)/python -m pytest

test-deploy: $(READY) ## All faults in all phases, and the longer tests of the robot's processes
	$(BIN)/python -m pytest -m "deploy or matrix"

lint: $(READY) ## Style, format and types; changes nothing
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY) ## Format the code, mend what ruff can mend
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

ci: ## What continuous integration runs
	bash .ci/run

clean: ## Remove the environment and caches; trained policies and out/ stay
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

# torch goes first, alone: an index that offers a CPU build decides then, and nothing after it asks for
# another one. It brings setuptools along, which then builds hmc without a second download.
$(READY): pyproject.toml constraints.txt
	@if [ -z "$(PYTHON)" ]; then \
		echo "hmc needs Python 3.11, 3.12 or 3.13; found none of them as: $(CANDIDATES)." >&2; \
		echo "Install one, or name it: make PYTHON=/path/to/python3.12 $(MAKECMDGOALS)" >&2; exit 1; fi
	@$(PYTHON) -c 'import sys; v = sys.version_info; v >= (3, 11) or sys.exit("hmc needs Python 3.11 or \
	newer, $(PYTHON) is %d.%d: name another with make PYTHON=/path/to/python3.12" % v[:2])'
	@rm -f $@
	@echo "Setting up $(VENV): once, some minutes. It holds $(TORCH) and the rest of constraints.txt."
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "$(PYTHON) cannot make virtual environments: name another, make PYTHON=..." >&2; exit 1; }
	$(INSTALL) $(TORCH) setuptools
	$(INSTALL) --no-build-isolation -e '.[$(EXTRAS)]'
	@touch $@
