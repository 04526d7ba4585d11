# Everything a clone needs, each target with its own set-up: `make help` lists the targets.
#
#   PYTHON=python3.12 make run      another interpreter (3.11 or newer; only asked when .venv is first made)
#   make run ARGS="--config deploy/example.toml"
#   make test ARGS="-k wire -x"
#   make test WORKERS=0             in one process (for a debugger)

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

# Byte code is kept, whatever the shell says: without it each process that a test starts compiles all it imports anew
# (the daemon's imports: 5.9 s of CPU instead of 2.2).
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
BIN := $(VENV)/bin
UV_VERSION := 0.13.9
PREFIX ?= /opt/servo-daemon
ARGS ?=
# Test processes beside each other; auto: three on two cores (tests/conftest.py). Each keeps to one thread: several that
# wait for each other on one core crawl.
WORKERS ?= auto
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

# --no-deps: the lock is complete, nothing may be resolved beside it. --no-build-isolation: what has no wheel is built
# with the setuptools of the lock, not with whatever a registry offers today. Which registry: pip's own configuration.
# --no-compile: each module is compiled when it is first imported, not all of them now (deploy/install asks for --compile).
COMPILE ?= --no-compile
PIP := -m pip --disable-pip-version-check
PIP_INSTALL := $(PIP) install --no-deps --no-build-isolation --require-hashes $(COMPILE)

.PHONY: help
help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-13s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

.PHONY: run
run: $(VENV)/.project ## the daemon, with what running needs (ARGS: what follows `servo-daemon run`)
	@echo "servo-daemon run $(ARGS): first values in about 3 s; Ctrl-C ends it"
	@exec $(BIN)/servo-daemon run $(ARGS)

.PHONY: venv
venv: $(VENV)/.project $(VENV)/.development ## .venv with everything in it, exactly as locked: servo-daemon and all tools

.PHONY: test
test: venv ## the fast tests (ARGS for pytest)
	$(PYTEST) -m "not slow" $(ARGS)

.PHONY: test-slow
test-slow: venv ## the slow ones, and those of the whole system (ARGS for pytest)
	$(PYTEST) -m slow --timeout 600 $(ARGS)

.PHONY: matrix
matrix: venv ## hides every effect in hundreds of new captures and prints what was found (two hours; ARGS="--seed N" goes on)
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.recovery.matrix $(ARGS)

.PHONY: calibrate
calibrate: venv ## what every threshold is compared with, on motors that no test has (20 min, can be resumed; ARGS="tracker")
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.recovery.calibration $(ARGS)

.PHONY: mutants
mutants: venv ## puts faults into the code and writes to docs/mutants.md which of them a test notices (ARGS="--seed N" goes on)
	$(BIN)/python -m tests.mutants $(ARGS)

.PHONY: check-api
check-api: venv ## what OpenAPI allows and forbids against the API, ten minutes of schemathesis (EXAMPLES=1000)
	SERVO_API_EXAMPLES=$(or $(EXAMPLES),1000) $(BIN)/python -m pytest -q --timeout 3600 -m slow tests/property/test_api_schema.py

.PHONY: lint
lint: venv ## ruff, its formatter, mypy --strict, the import contracts
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

.PHONY: bench
bench: venv ## every benchmark, into docs/benchmarks.md (many hours); ARGS="wire-serial cost": only these
	$(BIN)/python -m benchmarks.report --measure $(or $(ARGS),all)

.PHONY: bench-report
bench-report: venv ## the tables of docs/benchmarks.md from what the benchmarks printed last (benchmarks/results)
	$(BIN)/python -m benchmarks.report

.PHONY: install
install: ## as root: into PREFIX (/opt/servo-daemon) without development tools, with the systemd unit and the udev rules
	./deploy/install $(PREFIX)

.PHONY: deb
deb: ## build/servo-daemon_VERSION_ARCHITECTURE.deb for the Debian that this is; needs debhelper
	./deploy/package

.PHONY: sbom
sbom: ## build/sbom.json: what requirements.lock installs, as a CycloneDX bill of materials
	@python3 deploy/sbom.py build/sbom.json

.PHONY: fuzz
fuzz: venv ## a million spoilt inputs for every decoder and reader, three minutes (INPUTS=1000000 SEED=1)
	$(BIN)/python -W ignore -m tests.fuzz --inputs $(or $(INPUTS),1000000) --seed $(or $(SEED),1)

.PHONY: lock
lock: $(VENV)/.lock-tools ## both locks to what pyproject.toml asks for, pins kept (ARGS=--upgrade: newest versions)
	$(UV_COMPILE) $(ARGS) pyproject.toml --group build --override <(echo '$(NOT_USED)') -o requirements.lock
	$(UV_COMPILE) $(ARGS) --group dev -c requirements.lock -o requirements-dev.lock

# One lock for Linux, macOS and Windows from 3.11 on, with the hash of every file the registry has of each version.
UV_COMPILE := $(VENV)/.lock-tools/bin/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-emit-find-links --no-header --no-annotate

# What a dependency asks for and what runs does not use: filterpy draws with it, and imports it only there.
NOT_USED := matplotlib; python_version < "3"

.PHONY: clean
clean: ## removes .venv and every cache of the tools
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find servo_daemon drivers tests benchmarks -type d -name __pycache__ -prune -exec rm -rf {} +

# An interpreter that is there and new enough: PYTHON, or the first that answers.
FIND_PYTHON = for python in $(or $(PYTHON),python3 python3.13 python3.12 python3.11); do \
	if "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then echo "$$python"; exit; fi; done; \
	echo "make: no Python 3.11 or newer as: $(or $(PYTHON),python3 python3.13 python3.12 python3.11);" \
	"install one or say PYTHON=/path/to/python3" >&2; exit 1

# $(call install,LOCK): what LOCK names, said package by package, and how long it took; pip's remarks only if it fails.
define install
@echo "$(VENV): installing the $$(grep -c '^[a-z].*==' $(1)) packages of $(1)"; \
$(BIN)/python $(PIP_INSTALL) -r $(1) 2> $(VENV)/pip.log | while read -r verb what _; do case $$verb in \
  Collecting | Processing) what=$${what##*/}; printf ' %s' "$${what%%[-=<>]*}" ;; \
  Installing) printf '\n%s: unpacking them\n' $(VENV) ;; esac; done || { echo; cat $(VENV)/pip.log >&2; exit 1; }; \
$(BIN)/python deploy/slim.py; \
echo "$(VENV): done in $$SECONDS s, $$(du -sh $(VENV) | cut -f1) on disk"
endef

# A virtual environment that still runs is kept, whoever made it; one whose interpreter is gone is made anew.
$(VENV)/.runtime: requirements.lock
	@if ! $(BIN)/python -c 'import pip' 2>/dev/null; then \
	  python=$$($(FIND_PYTHON)); echo "$(VENV): $$($$python --version), $$(command -v $$python)"; \
	  echo "$(VENV): less than a minute with a warm package cache; else as long as 170 MB take to download"; \
	  $$python -m venv --clear $(VENV) || { echo "make: 'python3 -m venv' failed" \
	    "(on Debian and Ubuntu it is a package of its own: apt install python3-venv)" >&2; exit 1; }; fi
	@$(BIN)/python $(PIP_INSTALL) --quiet -r <(sed -n '/^setuptools==/,/[^\\]$$/p' requirements.lock)
	$(call install,requirements.lock)
	@touch $@

$(VENV)/.project: $(VENV)/.runtime pyproject.toml
	@$(BIN)/python $(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# After .project, never beside it: one pip at a time.
$(VENV)/.development: requirements-dev.lock | $(VENV)/.project
	$(call install,requirements-dev.lock)
	@$(BIN)/python $(PIP) --quiet check
	@touch $@

$(VENV)/.lock-tools: | $(VENV)/.development
	$(BIN)/python -m venv $@
	$@/bin/python $(PIP) install --quiet uv==$(UV_VERSION)
