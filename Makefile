# Every target that does a stage is one `gw` call; `make help` lists what there is.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

PYTHON ?= python3
VENV ?= .venv
PIP_FLAGS ?=
GW := $(VENV)/bin/gw
READY := $(VENV)/.ready
DEMO ?= demo
PRESET ?= draft
CAPTURE ?=
SUBJECT ?=
STAGE_FLAGS ?=

.PHONY: help setup demo test test-long check audit docs release-check format subject register-template canonicalize segment-layers bake-maps train fit-cloth evaluate status clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 20

setup: $(READY) ## make the virtual environment from the lock

$(READY): pyproject.toml constraints.txt
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) -c constraints.txt -e '.[dev]'
	touch $@

demo: $(READY) ## synthesise two subjects, learn both, swap a skirt: demo/index.html
	$(GW) demo -o $(DEMO) --preset $(PRESET)

test: $(READY) ## the test suite
	$(VENV)/bin/python -m pytest

test-long: $(READY) ## the full-size versions of the checks
	$(VENV)/bin/python -m pytest -m long --timeout 3600

check: $(READY) ## format, lint, types
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

audit: $(READY) ## ask the network for known findings in what is locked (needs pip-audit)
	$(VENV)/bin/python -m pip_audit --disable-pip --require-hashes -r requirements.lock

docs: $(READY) ## make the generated pages of docs/ again
	$(VENV)/bin/python -m gw_cli.reference docs/commands.md
	$(VENV)/bin/python -m tests.benchmarks.stability -o build/stability && cp build/stability/stability.md docs/stability.md

release-check: $(READY) ## build wheel and source archive, install into an empty environment, use it outside
	$(VENV)/bin/python -m pytest tests/release -m "long or not long" --timeout 3600

format: $(READY) ## rewrite the sources in the project's format
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

subject: register-template canonicalize segment-layers bake-maps train fit-cloth evaluate ## CAPTURE=… SUBJECT=…: the whole chain

register-template: $(READY) ## CAPTURE=… SUBJECT=…
	$(GW) register-template $(CAPTURE) -o $(SUBJECT) --preset $(PRESET) $(STAGE_FLAGS)

canonicalize: $(READY) ## SUBJECT=…
	$(GW) canonicalize $(SUBJECT) --preset $(PRESET)

segment-layers: $(READY) ## SUBJECT=…
	$(GW) segment-layers $(SUBJECT) --preset $(PRESET)

bake-maps: $(READY) ## SUBJECT=…
	$(GW) bake-maps $(SUBJECT) --preset $(PRESET)

train: $(READY) ## SUBJECT=…
	$(GW) train $(SUBJECT) --preset $(PRESET)

fit-cloth: $(READY) ## SUBJECT=…
	$(GW) fit-cloth $(SUBJECT) --preset $(PRESET)

evaluate: $(READY) ## SUBJECT=…
	$(GW) evaluate $(SUBJECT)

status: $(READY) ## SUBJECT=…
	$(GW) status $(SUBJECT)

clean: ## remove the virtual environment, caches and the demo
	rm -rf $(VENV) $(DEMO) .pytest_cache .mypy_cache .ruff_cache build *.egg-info
