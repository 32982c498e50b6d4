# make demo: set up and run the main job.   make test: set up and pass the tests.
# make demo-robot: the same task through two emulated UR5e.

VENV   ?= .venv
BIN    := $(VENV)/bin
# The first interpreter that runs and has a version the project is tested with.
PYTHON ?= $(shell for python in python3 python3.11 python3.12; do \
  $$python -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13))' 2>/dev/null \
  && echo $$python && break; done)
OUT    ?= out/demo

# Numerical libraries run one thread each: faster here, and steadier, than two on small problems.
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
export MUJOCO_GL ?= egl

.PHONY: demo demo-robot test test-all bench validation pictures soak lint clean egl

demo: $(VENV)/.base egl
	$(BIN)/dlo demo --out $(OUT) --overwrite

demo-robot: $(VENV)/.robot egl
	$(BIN)/dlo robot demo --out $(OUT)-robot --overwrite

test: lint egl
	$(BIN)/pytest

test-all: lint egl
	$(BIN)/pytest -m "slow or not slow"

bench: $(VENV)/.all egl
	$(BIN)/python -m benchmarks

validation: $(VENV)/.all
	$(BIN)/python -m benchmarks.validation

pictures: $(VENV)/.all egl
	$(BIN)/python -m benchmarks.pictures

soak: $(VENV)/.all egl
	$(BIN)/python -m benchmarks.soak_robot --minutes 30

lint: $(VENV)/.all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

clean:
	rm -rf $(VENV) build *.egg-info .pytest_cache .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Setting up -------------------------------------------------------------------------------------

$(VENV)/.venv:
	@test -n "$(PYTHON)" \
	  || { echo "dlo-gym needs Python 3.11 or 3.12; say where with  make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	@touch $@

$(VENV)/.base: $(VENV)/.venv pyproject.toml constraints.txt
	$(BIN)/pip install --quiet -c constraints.txt -e .
	@touch $@

$(VENV)/.robot: $(VENV)/.venv pyproject.toml constraints.txt
	$(BIN)/pip install --quiet -c constraints.txt -e '.[robot]'
	@touch $@ $(VENV)/.base

$(VENV)/.all: $(VENV)/.venv pyproject.toml constraints.txt
	$(BIN)/pip install --quiet -c constraints.txt -e '.[all]'
	@touch $@ $(VENV)/.base $(VENV)/.robot

EGL_PACKAGES := libegl1 libegl-mesa0 libgl1-mesa-dri

# MuJoCo renders headless through EGL, a system library.
egl:
	@ldconfig -p 2>/dev/null | grep -q libEGL.so.1 && exit 0; \
	if command -v apt-get >/dev/null && [ "$$(id -u)" = 0 ]; then \
	  apt-get update -qq && apt-get install -y -qq $(EGL_PACKAGES); \
	elif command -v apt-get >/dev/null && sudo -n true 2>/dev/null; then \
	  sudo apt-get update -qq && sudo apt-get install -y -qq $(EGL_PACKAGES); \
	else \
	  echo "libEGL is missing; install it, on Debian or Ubuntu:  sudo apt-get install $(EGL_PACKAGES)"; \
	  exit 1; \
	fi
