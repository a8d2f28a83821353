# Everything lives in .venv, made on first use; `make` alone lists what there is.

PYTHON ?= python3
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

# The editable install names this folder, so a moved or copied checkout installs again.
INSTALLED := .venv/.installed-$(shell printf %s "$(CURDIR)" | cksum | cut -d' ' -f1)
BIN := .venv/bin
# Bytecode is kept whatever the shell says: tests start many processes.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/python -m pip --disable-pip-version-check

# One thread a test worker: pytest runs one worker a core. Tests compile more than they compute: without
# the newer emitters, at level 0 and in one piece XLA takes a third of the time for it.
ONE_THREAD := NPROC=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
	XLA_FLAGS="--xla_cpu_multi_thread_eigen=false --xla_backend_optimization_level=0 \
	--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 $(XLA_FLAGS)"

.PHONY: help
help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 12

.PHONY: install
install: $(INSTALLED) ## make .venv with the pinned versions (every other target does it too)

$(INSTALLED): requirements.txt pyproject.toml
	@if ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
		$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
			echo "spinndrift needs Python 3.11 or newer, but $(PYTHON) is" \
				"$$($(PYTHON) --version 2>&1 || true)." \
				"Name another one: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 1; }; \
		echo "making .venv with $$($(PYTHON) --version)"; \
		rm -rf .venv; \
		$(PYTHON) -m venv .venv || { rm -rf .venv; \
			echo "$(PYTHON) can't make .venv: install its venv module" \
				"(on Debian: apt-get install python3-venv)" >&2; exit 1; }; \
	fi
	@echo "installing the versions that requirements.txt names (about 1 GB, once)"
	@$(PIP) install $(if $(CI),--quiet) --no-deps -r requirements.txt
	@$(PIP) install --quiet --no-deps --no-index --no-build-isolation --editable .
	@$(PIP) check
	@rm -f .venv/.installed-* && touch $@

.PHONY: demo
demo: $(INSTALLED) ## a log goes in, a learned vehicle flies a dive; LOG=path takes your own log
	@$(BIN)/spinndrift demo $(if $(LOG),--log "$(LOG)")

.PHONY: test
test: style ## lint, types, all tests, and the smoke part against the built wheel
	@$(MAKE) --no-print-directory --jobs 2 types unit
	@$(MAKE) --no-print-directory smoke

.PHONY: lint
lint: style types ## ruff (lint and format) and basedpyright

.PHONY: style
style: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet . || { echo "run: make format" >&2; exit 1; }

.PHONY: types
types: $(INSTALLED)
	$(BIN)/basedpyright --warnings

.PHONY: unit
unit: $(INSTALLED) ## all tests, one worker a core
	$(ONE_THREAD) $(BIN)/python -m pytest -n auto --dist worksteal --durations 40

.PHONY: slow
slow: $(INSTALLED) ## the tests left out of `make test` for the time they take
	$(ONE_THREAD) $(BIN)/python -m pytest -n auto -m slow

# `-P` and another working folder keep the tree out; a test checks which copy was imported. Types
# are checked in `unit` alone: that doubles the time of the imports.
SMOKE := $(shell grep -l "mark\.smoke" tests/test_*.py)
.PHONY: smoke
smoke: $(INSTALLED) ## the tests marked smoke against the built wheel
	@rm -rf build/wheel build/lib build/bdist.* && mkdir -p build/wheel/run
	$(BIN)/python -m build --quiet --wheel --no-isolation --outdir build/wheel
	@$(PIP) install --quiet --no-deps --no-index --target build/wheel/installed \
		build/wheel/spinndrift-*.whl
	cd build/wheel/run && $(ONE_THREAD) PYTHONPATH="$(CURDIR)/build/wheel/installed" \
		SPINNDRIFT_EXPECTED_UNDER="$(CURDIR)/build/wheel/installed" "$(CURDIR)/$(BIN)/python" -P \
		-m pytest -m smoke -n auto --dist worksteal -c "$(CURDIR)/pyproject.toml" \
		-o addopts="--import-mode=importlib --strict-config --strict-markers" \
		--rootdir "$(CURDIR)" $(addprefix "$(CURDIR)"/,$(SMOKE))

.PHONY: format
format: $(INSTALLED) ## let ruff mend and lay out the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.PHONY: bench
bench: $(INSTALLED) ## the benchmarks, on a quiet machine; ONLY=word picks some
	$(BIN)/python -m pytest -q -o addopts= --import-mode=importlib --benchmark-only \
		benchmarks $(if $(ONLY),-k "$(ONLY)")

.PHONY: blind
blind: $(INSTALLED) ## write cases of hidden effects for `spinndrift check diagnosis` into runs/blind
	PYTHONPATH=tests $(BIN)/python -m hidden runs/blind --scale $(or $(SCALE),small) \
		$(if $(NULLS),--nulls $(NULLS))

.PHONY: fuzz
fuzz: $(INSTALLED) ## N=100000 mutated inputs of each kind of file; ONLY=bin, FIRST=number to go on
	$(ONE_THREAD) PYTHONPATH=tests $(BIN)/python -m fuzz --count $(or $(N),100000) \
		--first $(or $(FIRST),0) $(if $(ONLY),--only $(ONLY))

.PHONY: lock
lock: ## write requirements.txt anew with the newest versions that pyproject.toml allows
	@rm -rf build/lock && mkdir -p build && $(PYTHON) -m venv build/lock
	build/lock/bin/python -m pip install --quiet .[dev]
	@{ echo "# Exact versions of all that is used, tests and tools included. Written by: make lock"; \
		build/lock/bin/python -m pip freeze --all | grep -v -E '^(pip|spinndrift)\b' \
		| sed -E 's/^(Mosek==.*)/\1; platform_machine != "aarch64"/'; } > requirements.txt
	@rm -rf build/lock

.PHONY: clean
clean: ## remove what was built and cached (.venv stays; remove it by hand)
	rm -rf build dist src/*.egg-info .pytest_cache .ruff_cache .hypothesis .benchmarks .jax_cache
	find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +
