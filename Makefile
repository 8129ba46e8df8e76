# Two commands do everything on a machine with Python ≥ 3.11 (with venv) and make:
#   make demo   the main job on the embedded mock robot
#   make test   the tests
# System packages: python3 (≥ 3.11), python3-venv, make. Nothing else.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
RUNS ?= runs
# One BLAS thread per process: with two, idle threads spin and cost more than they bring.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1

# Pytest keeps the test modules that it has rewritten; without them, collecting takes three times as long.
unexport PYTHONDONTWRITEBYTECODE

OFTEN := journey or not (thorough or wire or matrix or proof)

.PHONY: help demo check test test-all lint types walls shape proof proof-state fault-matrix gallery fuzz soak bench wheels docs example clean

##@ Start here

help: ## list these targets
	@awk '/^##@ /{print "\n" substr($$0, 5)} /^[a-z-]+:.*## /{n=$$0; sub(/:.*/,"",n); t=$$0; sub(/.*## /,"",t); printf "  %-14s %s\n", n, t}' $(MAKEFILE_LIST)

$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python ≥ 3.11 is needed; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.demo: $(VENV)/.made pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[mock,identify,web]"
	@touch $@

# torch from PyPI brings CUDA along, gigabytes of it. Where there is no GPU, the small build does:
#   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make test
$(VENV)/.dev: $(VENV)/.made pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[mock,learn,fleet,dev]"
	@touch $@ $(VENV)/.demo

demo: $(VENV)/.demo ## record, fit, validate and report two programs on the mock robot
	$(BIN)/hil run experiments/ur5_fourier.yaml --runs $(RUNS)
	$(BIN)/hil run experiments/ur5_dwell_650.yaml --runs $(RUNS)
	$(BIN)/hil runs --runs $(RUNS)
	@echo 'look at them, and start runs of your own, in a browser: $(BIN)/hil serve'

##@ Before every commit

check: lint types walls ## run lint, types and walls: less than a minute with warm caches

lint: $(VENV)/.dev ## check with ruff: style, docstrings, formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev ## check types: mypy --strict
	$(BIN)/mypy

walls: $(VENV)/.dev ## check import contracts (docs/explanation/architecture.md)
	$(BIN)/lint-imports

test: $(VENV)/.dev ## test every package and one journey over each protocol (6 minutes on 2 cores); of one package: make test OF=tests/core
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "$(OFTEN)" $(OF)

shape: ## print files, lines and importers per package, and import cycles (information only)
	@$(PYTHON) tests/house/shape.py

##@ Before a release, and in CI (.ci/run)

# Only files that have a marker are collected. Tests that wait for sockets or simulated drives use
# little CPU, so three pytest workers share two cores.
test-all: test ## run all other tests too (25 to 30 minutes): every wire test, sampled faults, commands of the documentation
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder \
	  -m "(thorough or wire or matrix) and not (proof or journey)" \
	  $$(grep -rlE --include='test_*.py' 'mark\.(thorough|wire|matrix)' tests | sort)

# The theme of MkDocs announces a successor of MkDocs in every build; the variable silences that.
docs: $(VENV)/.dev ## build the documentation (site/index.html, works offline)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

proof-state: ## list stale proofs and their durations
	@$(PYTHON) -m tests.proofs --list

proof: $(VENV)/.dev ## run the stale proofs (hours), or some: make proof UNIT="static ur-programs"
	$(BIN)/python -m tests.proofs $(UNIT)

##@ Single long checks

fuzz: $(VENV)/.dev ## feed thousands of damaged specs, stations, run directories and recordings
	HIL_FUZZ_EXAMPLES=$${HIL_FUZZ_EXAMPLES:-3000} $(BIN)/python -m tests.proofs.fuzz_long

soak: $(VENV)/.dev ## record a simulated day at 500 Hz
	$(BIN)/hil bench soak --hours 24

bench: $(VENV)/.dev ## run every benchmark, each against a peer in the same run
	$(BIN)/hil bench all

wheels: $(VENV)/.dev ## install the wheel with each set of extras under each installed Python
	$(BIN)/python -m tests.proofs.install_matrix

example: $(VENV)/.dev ## run the CI of the example projects against the wheel of this checkout
	PYTHON=$(abspath $(BIN)/python) examples/against-the-wheel.sh

##@ Generated pages

fault-matrix: $(VENV)/.dev ## run the fault matrix and write its tables in docs/reference/fault-matrix*.md
	$(BIN)/python -m tests.faults.table

gallery: $(VENV)/.dev ## draw the pictures of docs/gallery.md (minutes; needs Chromium)
	$(BIN)/python -m tests.docs.gallery

##@ Housekeeping

clean: ## remove the virtual environment and caches (runs are kept)
	rm -rf $(VENV) build site *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
