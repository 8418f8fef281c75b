# Everything runs in a virtual environment of its own, made on first use.
#   make test PYTHON=python3.12 VENV=.venv312 TORCH="torch==2.4.*"

PYTHON ?= python3
VENV   ?= .venv
TORCH  ?=

BIN    := $(VENV)/bin
CHECKS := --jaxtyping-packages=torchtex,beartype.beartype

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow lint format bench bench-peers clean

help:  ## Show this list
	@grep -E '^[a-z-]+:.*##' $(firstword $(MAKEFILE_LIST)) | sed -E 's/:.*## */\t/' | expand -t 14
	@echo
	@echo 'Variables: PYTHON (an interpreter, now $(PYTHON)), VENV (a folder, now $(VENV)),'
	@echo 'TORCH (a requirement installed first, such as "torch==2.4.*")'

demo: $(VENV)/installed  ## Make demo/gravel.png, a 256 x 256 texture from a bundled exemplar
	@mkdir -p demo
	$(BIN)/torchtex synth gravel -o demo/gravel.png --size 256x256
	@echo "The texture is in $(CURDIR)/demo/gravel.png"

test: lint  ## Check format, style and types, and run the quick tests
	$(BIN)/python -m pytest $(CHECKS) -m "not slow"

test-slow: $(VENV)/installed-dev  ## Run the slow tests
	$(BIN)/python -m pytest $(CHECKS) -m slow

lint: $(VENV)/installed-dev  ## Check format, style and types
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy

format: $(VENV)/installed-dev  ## Format the code and repair what ruff can
	$(BIN)/python -m ruff format .
	$(BIN)/python -m ruff check --fix .

bench: $(VENV)/installed-dev  ## Measure torchtex; see benchmarks/
	for script in bench cuts search poisson tiles fill holes flow analogies design marbling skeletal \
		solids; do \
		$(BIN)/python benchmarks/$$script.py || exit 1; \
	done

bench-peers: $(VENV)/installed-dev  ## Measure torchtex beside other programs that are installed
	$(BIN)/python benchmarks/peers.py

clean:  ## Remove the environment, the demo and all caches
	rm -rf "$(VENV)" demo build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find torchtex tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	$(PYTHON) -m venv "$(VENV)"

$(VENV)/installed: pyproject.toml | $(BIN)/python
	$(if $(strip $(TORCH)),$(BIN)/python -m pip install "$(TORCH)")
	$(BIN)/python -m pip install -e .
	@touch $@

$(VENV)/installed-dev: pyproject.toml | $(BIN)/python
	$(if $(strip $(TORCH)),$(BIN)/python -m pip install "$(TORCH)")
	$(BIN)/python -m pip install -e ".[dev]"
	@touch $@ $(VENV)/installed
