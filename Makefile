# make demo      set up and train BRO on a DeepMind Control task (about 8 minutes on 2 cores)
# make test      set up, lint, types, tests (what CI runs)
# make test-all  the same with the long tests
# make clean     remove the virtual environment

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: demo demo-imports test test-all lint check-python clean

check-python:
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; \
	    sys.exit(0 if v == (3, 11) else "The lock file is for Python 3.11, and %s is %d.%d: make PYTHON=python3.11 ..." % ("$(PYTHON)", *v))'

$(BIN)/python: | check-python
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip setuptools wheel

$(VENV)/.demo: setup.cfg constraints.txt | $(BIN)/python
	@echo "Installing what the demo needs into $(VENV) ..."
	$(PIP) torch
	$(PIP) -e ".[dmc,plots,progress]"
	@touch $@

$(VENV)/.all: setup.cfg constraints.txt | $(BIN)/python
	@echo "Installing everything into $(VENV) (some minutes) ..."
	$(PIP) torch
	$(PIP) -e ".[all,tests]"
	@touch $@

demo: $(VENV)/.demo
	$(BIN)/python examples/demo.py

lint: $(VENV)/.all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy sb3_sample

test: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -rs -m "not slow" -n 2

# The demo has to run with the extras that it installs, not with what a full environment happens to hold.
demo-imports: setup.cfg constraints.txt | check-python
	rm -rf .venv-demo
	$(MAKE) --no-print-directory VENV=.venv-demo .venv-demo/.demo
	.venv-demo/bin/python examples/demo.py --help > /dev/null
	rm -rf .venv-demo

test-all: lint demo-imports
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -rs -n 2

clean:
	rm -rf $(VENV)
