# make demo      set up and train BRO on a DeepMind Control task (2 minutes on 2 free cores)
# make test      set up, lint, types, tests (what CI runs)
# make test-all  the same with the long tests
# make evidence  go on with the runs of studies/evidence (WORKERS=2: two at once; THREADS=2: of each)
# make evidence-pages  write what has come of them into the pages of docs
# make gpu       tests and benchmark of a GPU, with that machine's own torch; without a package registry there, take
#                along what `make gpu-wheels` gathers into .gpu/wheels on a machine with one
# make gpu-evidence  ten seeds of BRO Fast on a GPU, six minutes
# make clean     remove the virtual environment
#
# make PYTHON=python3.13 ...  sets up with another Python than python3, one of those below

# The Pythons that there is a lock file for: constraints/3.11.txt and so on.
PYTHONS := 3.11 3.12 3.13 3.14
# Those that labmaze has wheels for.
LABMAZE_PYTHONS := 3.11 3.12

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
version = $(shell $(1) -c 'import sys; print("%d.%d" % sys.version_info[:2])')
VERSION := $(call version,$(PYTHON))
LOCK := constraints/$(VERSION).txt
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(LOCK)
# rliable asks for a release of arch that has no wheel for Python 3.14. Built from source without its compiled parts it
# needs no compiler; wheels, where there are some, are the same as ever.
export ARCH_NO_BINARY := 1

# dm-control asks for labmaze, which has no wheel after Python 3.12 and which its suite never imports. There the extra
# [dmc] is everything else that dm-control asks for.
ifeq (,$(filter $(VERSION),$(LABMAZE_PYTHONS)))
DM_CONTROL = $(PIP) --no-deps dm-control
else
DM_CONTROL = @:
endif

ifneq (,$(filter-out clean lock,$(or $(MAKECMDGOALS),demo)))
ifeq (,$(filter $(VERSION),$(PYTHONS)))
$(error $(PYTHON) is Python $(or $(VERSION),?), and there are lock files for $(PYTHONS): make PYTHON=python3.12 ..., say)
endif
ifneq (,$(wildcard $(BIN)/python))
ifneq ($(VERSION),$(call version,$(BIN)/python))
$(error $(PYTHON) is Python $(VERSION), and $(VENV) was made with $(call version,$(BIN)/python): make clean, then again)
endif
endif
endif

.PHONY: demo demo-imports test test-all lint evidence evidence-pages gpu gpu-wheels gpu-evidence lock clean


$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip setuptools wheel

$(VENV)/.demo: setup.cfg $(LOCK) | $(BIN)/python
	@echo "Installing what the demo needs into $(VENV) (Python $(VERSION)) ..."
	$(PIP) torch
	$(PIP) -e ".[dmc,plots,progress]"
	$(DM_CONTROL)
	@touch $@

$(VENV)/.all: setup.cfg $(LOCK) | $(BIN)/python
	@echo "Installing everything into $(VENV) (Python $(VERSION), some minutes) ..."
	$(PIP) torch
	$(PIP) -e ".[all,tests]"
	$(DM_CONTROL)
	@touch $@

demo: $(VENV)/.demo
	$(BIN)/python examples/demo.py

lint: $(VENV)/.all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2 sb3_sample
	$(BIN)/lint-imports

# Tests start many programs, each of which would compile the whole package where bytecode is not kept.
TESTING := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=

test: lint
	$(TESTING) $(BIN)/python -m pytest -rs -m "not slow" -n 2 --dist worksteal

# On a GPU: torch, NumPy, SciPy, pytest and their like are there; what is carried along is put beside them.
GPU_FOLDER := .gpu
GPU_RUN = PYTHONPATH=$(CURDIR):$(CURDIR)/$(GPU_FOLDER)/site OMP_NUM_THREADS=1 MUJOCO_GL=disabled $(PYTHON)

gpu-wheels:
	$(PYTHON) benchmarks/gpu_wheels.py $(GPU_FOLDER)/wheels

$(GPU_FOLDER)/site: $(wildcard $(GPU_FOLDER)/wheels/*.whl)
	$(if $^,$(PYTHON) -m pip install --quiet --no-index --no-deps --no-compile --upgrade --target $@ $^,mkdir -p $@)
	@touch $@

gpu: $(GPU_FOLDER)/site
	$(GPU_RUN) -m pytest -q -rs -m gpu -n 8 tests/test_gpu.py
	$(GPU_RUN) benchmarks/gpu.py
	$(GPU_RUN) benchmarks/gpu.py --parts simba,simbav2,brc,crossq,xqc,flash,dr_q

gpu-evidence: $(GPU_FOLDER)/site
	$(GPU_RUN) benchmarks/gpu_evidence.py $(GPU_FOLDER)/evidence

# The demo has to run with the extras that it installs, not with what a full environment happens to hold.
demo-imports: setup.cfg $(LOCK)
	rm -rf .venv-demo
	$(MAKE) --no-print-directory VENV=.venv-demo .venv-demo/.demo
	.venv-demo/bin/python examples/demo.py --help > /dev/null
	rm -rf .venv-demo

# With Ray too, which [all] leaves out.
test-all: lint demo-imports
	$(PIP) -e ".[cluster]"
	$(TESTING) $(BIN)/python -m pytest -rs -n 2 --dist worksteal --durations=60

WORKERS ?= 1
THREADS ?= 1
evidence:
	$(PYTHON) studies/evidence.py --workers $(WORKERS) --threads $(THREADS)

evidence-pages: $(VENV)/.all
	$(BIN)/python studies/evidence_pages.py

# Resolves the lock files anew, for maintainers: needs uv (pip install uv), installs nothing. A version stays where it
# still fits; empty a file to have its Python's newest ones. Nothing is built but this package's own metadata (first, for
# uv's cache) and what has no wheel at all, pure Python but for arch.
lock: $(PYTHONS:%=constraints/%.lock)

constraints/%.lock:
	uv pip compile setup.cfg --python-version $* --no-deps --quiet > /dev/null
	uv pip compile setup.cfg constraints/pins.txt --python-version $* --all-extras --quiet \
	    --no-annotate --custom-compile-command "make lock" \
	    $(if $(filter $*,$(LABMAZE_PYTHONS)),,--excludes constraints/no_wheel.txt) \
	    --only-binary :all: $(foreach p,rliable moviepy proglog $(if $(filter $*,3.14),arch),--no-binary $(p)) \
	    -o constraints/$*.txt

clean:
	rm -rf $(VENV)
