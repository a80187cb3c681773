# Needs Python 3.11 or newer, pip and GNU make (3.81 or newer). `make help` lists the targets.
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
SHELL := /bin/sh

PYTHON ?=
OUT ?=
ARGS ?=
UPGRADE ?=
export PYTHON
unexport PYTHONPATH PYTHONHOME

PY := .venv/bin/python
# Non-empty when .venv is missing, incomplete, or made from other locks, elsewhere, or by another PYTHON.
STALE = $(shell PYTHON='$(PYTHON)' sh tools/setup_venv.sh check >/dev/null 2>&1 || echo stale)

.PHONY: help setup reproduce test soak oldest bench coverage mutants lint format notebooks lock clean FORCE

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile
	@echo '  Variables: PYTHON=python3.12 chooses the interpreter, OUT=dir the output of reproduce,'
	@echo '  ARGS="-k name" goes to pytest, UPGRADE=1 lets lock take newer versions.'

.venv/.ready: $(if $(STALE),FORCE)
	@sh tools/setup_venv.sh

setup: .venv/.ready ## create .venv from the hash-locked requirements (the other targets do it too)

reproduce: .venv/.ready ## regenerate the published results (OUT=dir: where to)
	.venv/bin/pk-jax reproduce $(if $(OUT),--out '$(OUT)')

test: .venv/.ready ## run the test suite
	$(PY) -m pytest -n 2 $(ARGS)

soak: .venv/.ready ## run the long randomized tests
	$(PY) -m pytest -m soak $(ARGS)

oldest: .venv/.ready ## run the test suite with the oldest versions that pyproject.toml allows
	.venv/bin/uv venv --quiet --allow-existing --python $(PY) .oldest
	.venv/bin/uv pip install --quiet --python .oldest --resolution lowest-direct -e '.[test,bench,notebooks]'
	.oldest/bin/python -m pytest -n 2 $(ARGS)

DOOR = pk_jax/checks.py,pk_jax/files/*
coverage: .venv/.ready ## lines and branches reached by the test suite; all of those of input and files
	rm -f .coverage .coverage.*
	$(PY) -m coverage run -m pytest -n 2 $(ARGS)
	$(PY) -m coverage combine --quiet
	$(PY) -m coverage report
	$(PY) -m coverage report --include='$(DOOR)' --fail-under=100

mutants: .venv/.ready .mutants/.ready ## change the code in 200 ways: do the tests notice? (an hour; it resumes)
	.mutants/venv/bin/python tools/mutants.py $(ARGS)

.mutants/.ready: requirements/mutants.lock
	$(PY) -m venv --clear .mutants/venv
	.mutants/venv/bin/python -m pip install --quiet --require-hashes -r requirements/mutants.lock
	touch $@

bench: .venv/.ready ## run every benchmark
	@for file in benchmarks/[!_]*.py; do \
	  [ -f "$$file" ] || continue; \
	  name=`basename "$$file" .py`; \
	  echo "$(PY) -m benchmarks.$$name"; \
	  $(PY) -m "benchmarks.$$name" || exit 1; \
	done

lint: .venv/.ready ## check style and formatting
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

format: .venv/.ready ## fix what the linter can fix
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

notebooks: .venv/.ready ## execute notebooks/*.py into .ipynb files
	JUPYTER_PREFER_ENV_PATH=1 $(PY) -m jupytext --to ipynb --set-kernel python3 --execute notebooks/*.py

COMPILE = .venv/bin/uv pip compile --no-config --quiet --universal --fork-strategy fewest --generate-hashes --python-version 3.11 \
  --default-index https://pypi.org/simple --custom-compile-command 'make lock' $(if $(UPGRADE),--upgrade)

lock: .venv/.ready ## regenerate requirements/*.lock (UPGRADE=1: with newer versions)
	@test -x .venv/bin/uv || { echo 'make lock needs uv, which could not be installed here' >&2; exit 1; }
	$(COMPILE) --extra test --extra bench --extra notebooks --extra lint \
	  pyproject.toml requirements/build.in -o requirements/dev.lock
	$(COMPILE) requirements/installer.in -o requirements/installer.lock
	$(COMPILE) requirements/mutants.in -o requirements/mutants.lock

clean: ## remove .venv, caches and build products (never runs/)
	rm -rf .venv .mutants .oldest build dist .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	find . -name .ipynb_checkpoints -type d -prune -exec rm -rf {} +
