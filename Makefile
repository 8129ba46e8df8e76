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

.PHONY: help demo test test-all lint types walls shape proof proof-state fault-matrix gallery fuzz soak bench wheels docs example clean

help:
	@sed -n '/^[a-z-]*:.*##/s/:.*##/ —/p' $(MAKEFILE_LIST)

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

test: $(VENV)/.dev ## tests of every package, a journey over each protocol (six minutes on two cores), or: make test OF=tests/core
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "$(OFTEN)" $(OF)

# Only files that have a marker are collected. Tests that wait for sockets or simulated drives use
# little CPU, so three pytest workers share two cores.
test-all: test ## and all others (25 to 30 minutes): every wire test, each fault at one kind of step, commands of the docs
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder \
	  -m "(thorough or wire or matrix) and not (proof or journey)" \
	  $$(grep -rlE --include='test_*.py' 'mark\.(thorough|wire|matrix)' tests | sort)

fault-matrix: $(VENV)/.dev ## the same, and the tables in docs/reference/fault-matrix*.md
	$(BIN)/python -m tests.faults.table

gallery: $(VENV)/.dev ## the pictures of docs/gallery.md, by its commands (minutes; needs Chromium)
	$(BIN)/python -m tests.docs.gallery

fuzz: $(VENV)/.dev ## thousands of damaged specs, stations, run directories and recordings
	HIL_FUZZ_EXAMPLES=$${HIL_FUZZ_EXAMPLES:-3000} $(BIN)/python -m tests.proofs.fuzz_long

soak: $(VENV)/.dev ## a simulated day at 500 Hz through the recorder
	$(BIN)/hil bench soak --hours 24

lint: $(VENV)/.dev ## ruff: style, docstrings, formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev ## mypy --strict
	$(BIN)/mypy

walls: $(VENV)/.dev ## import contracts: what may not import what (docs/explanation/architecture.md)
	$(BIN)/lint-imports

shape: ## packages in order: files, lines, importers per module, import circles (information only)
	@$(PYTHON) tests/house/shape.py

proof: $(VENV)/.dev ## proofs whose inputs have changed since they passed, or: make proof UNIT="static ur-programs"
	$(BIN)/python -m tests.proofs $(UNIT)

proof-state: ## which proofs are stale, and how long they take
	@$(PYTHON) -m tests.proofs --list

wheels: $(VENV)/.dev ## the wheel in fresh environments: each set of extras under each Python at hand
	$(BIN)/python -m tests.proofs.install_matrix

bench: $(VENV)/.dev ## every benchmark, each against a peer in the same run
	$(BIN)/hil bench all

# MkDocs' theme tells every build that a successor of MkDocs is on its way.
docs: $(VENV)/.dev ## the documentation as a site that needs no network: site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

example: $(VENV)/.dev ## the example projects' own CI against the wheel of this checkout
	PYTHON=$(abspath $(BIN)/python) examples/against-the-wheel.sh

clean: ## remove the virtual environment and caches (runs are kept)
	rm -rf $(VENV) build site *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
