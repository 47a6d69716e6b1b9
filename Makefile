# Needs Python 3.11 to 3.14 with venv, and make. Everything else is installed into .venv, pinned.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
    command -v $$p >/dev/null && $$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' && echo $$p && break; done)
BIN := .venv/bin
READY := .venv/.ready
OUT ?= runs/demo
# A file at a time, since its tests share what is costly to make; the longest files first (tests/conftest.py).
PYTEST := $(BIN)/python -m pytest -rs -n 2 --dist loadfile --no-loadscope-reorder
# Packages are installed without bytecode, which each keeps once it was imported, unless told not to: then every start of `mevs`
# would compile them again, for 12 seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all lint bench docs wheel clean

demo: $(READY)  ## environment; the system of the package looks at a table; data, networks, evaluation, report
	@mkdir -p $(dir $(OUT))
	$(BIN)/mevs look --mesh table --draw $(OUT)-table.png
	@echo "A picture of it: $(OUT)-table.png"
	$(BIN)/mevs run --preset demo --out $(OUT)

test: lint  ## format, lint, types, and the tests that are not marked slow
	$(PYTEST) -m "not slow"

test-all: lint  ## the same with all tests
	$(PYTEST)

lint: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: export GLIBC_TUNABLES = glibc.malloc.hugetlb=1  # large pages, as `mevs` asks for them; peers have them, too
bench: $(READY)  ## what is fast, beside its peers, in one run
	$(BIN)/python benchmarks/points.py
	$(BIN)/python benchmarks/images.py --layers
	$(BIN)/python benchmarks/capture.py
	$(BIN)/python benchmarks/evaluation.py
	$(BIN)/python benchmarks/members.py

docs: .venv-docs/.ready  ## the documentation site, in site/; fails on a dead link
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --quiet --strict

.venv-docs/.ready: docs/requirements.txt
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -m pip install --quiet --disable-pip-version-check -r docs/requirements.txt
	touch $@

wheel: $(READY)  ## the library alone, as a wheel in dist/
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .

$(READY): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "mevs_jax needs Python 3.11 to 3.14; install one, or name it: make PYTHON=python3.12" >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15) and "mevs_jax needs Python 3.11 to 3.14, this is " + sys.version.split()[0] + "; name another: make PYTHON=python3.12")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

clean:  ## environment and builds; runs/ stays
	rm -rf .venv .venv-docs dist site

.PHONY: fuzz
fuzz: $(READY)  ## 20,000 mutated inputs for each reader of foreign files
	$(BIN)/python -m tests.fuzz.run
