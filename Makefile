# Needs python3 (3.11 or 3.12) with venv, and make. Everything else is installed into .venv, pinned.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
OUT ?= runs/demo
# A file at a time, since its tests share what is costly to make; the longest files first (tests/conftest.py).
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
# Packages are installed without bytecode, which each keeps once it was imported, unless told not to: then every start of `mevs`
# would compile them again, for 12 seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all lint bench clean

demo: $(READY)  ## environment, data, networks, evaluation, report
	$(BIN)/mevs run --preset small --out $(OUT)

test: lint  ## format, lint, types, and the tests that are not marked slow
	$(PYTEST) -m "not slow"

test-all: lint  ## the same with all tests
	$(PYTEST)

lint: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: $(READY)  ## what is fast, beside its peers, in one run
	$(BIN)/python benchmarks/points.py
	$(BIN)/python benchmarks/capture.py
	$(BIN)/python benchmarks/evaluation.py
	$(BIN)/python benchmarks/sweep.py

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 13) and "mevs_jax needs Python 3.11 or 3.12, this is " + sys.version.split()[0] + "; set PYTHON=python3.12, say")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

clean:
	rm -rf .venv runs dist
