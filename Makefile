# `make` alone lists the targets. Each one makes the environment it needs by itself.

VENV  := .venv
BIN   := $(VENV)/bin
READY := $(VENV)/.ready
PIP   := $(BIN)/python -m pip --disable-pip-version-check --quiet

# An environment that exists keeps its Python, unless PYTHON names one of another version.
VERSION := -c 'import sys; print(sys.version.split()[0])'
ifdef PYTHON
ifneq ($(shell ($(PYTHON) $(VERSION)) 2>/dev/null),$(shell ($(BIN)/python $(VERSION)) 2>/dev/null))
.PHONY: $(READY)
RENEW := yes
endif
endif
PYTHON ?= python3

# The tiers of the tests, by the markers of pyproject.toml.
PYTEST := pytest --numprocesses auto --maxprocesses 8 --dist worksteal
USERS := -m "not (long or study or process or broker or browser or pages)"
SYSTEM := -m "not (long or study) and (process or broker or browser or pages)"
LONG := -m "long and not study"
FAST := -m "not (slow or long or study or process or broker or browser or pages)"
# With other versions: the fast ones, and those of what brokers are spoken to with.
OTHERS := -m "not (slow or long or study or process or browser or pages)"
# Beside the oldest one of pyproject.toml: Pythons that they run on, where found.
VERSIONS := 3.12 3.13 3.14
# Extras that the tests need, and those of all work here.
EXTRAS := live,mesh,fleet,fmu
ALL_EXTRAS := $(EXTRAS),control
UV := UV_PYTHON_DOWNLOADS=never $(BIN)/uv
PYENV := $(or $(PYENV_ROOT),$(HOME)/.pyenv)/versions

# Byte code is kept, wherever the environment says not to: every program that a test starts, and every
# process that runs tests, would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE
# Tests run in as many processes as there are cores: threads of BLAS beside them cost a fifth.
export OMP_NUM_THREADS ?= 1

comma := ,
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-fast test-system test-long test-threads test-all coverage mpi lowest versions package platforms check format docs bench experiment lock clean

help:  ## List the targets
	@echo "make TARGET [PYTHON=python3.12]"
	@echo
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(READY)  ## Identify a furnace wall from thermocouples, then run the paper's first experiment
	@$(BIN)/livepde run examples/first_hour/furnace.toml
	@$(BIN)/livepde demo

test: $(READY)  ## Run the tests of what users rely on, and the doctests
	@$(BIN)/$(PYTEST) $(USERS)

test-fast: $(READY)  ## Run those that take a fraction of a second each
	@$(BIN)/$(PYTEST) $(FAST)

test-system: $(READY)  ## Run those with programs of their own, brokers, browsers and pages
	@$(BIN)/$(PYTEST) $(SYSTEM)

test-long: $(READY)  ## Run those that take longer, before a release and after changes of laws
	@$(BIN)/$(PYTEST) $(LONG)

test-threads: $(READY)  ## Run those of threads with 100 trials of each law
	@LIVEPDE_THREAD_TRIALS=100 $(BIN)/$(PYTEST) tests/test_threads.py

test-all: $(READY)  ## Run all: brokers, browsers, processes, studies and pages, too
	@$(BIN)/$(PYTEST)

coverage: $(READY)  ## Run all and measure coverage, which takes longer
	@$(BIN)/$(PYTEST) --cov

mpi:  ## Run the tests on several ranks, with Debian's PETSc in an environment of its own
	@.venv-petsc/bin/python -c 'import dolfinx, pytest, livepde; livepde.Model' 2>/dev/null || deploy/petsc.sh .venv-petsc
	@.venv-petsc/bin/python -m pip --disable-pip-version-check --quiet install pytest
	@.venv-petsc/bin/python -m pytest --quiet tests/test_petsc.py

lowest: $(READY)  ## Run the fast tests with the lowest versions of all dependencies
	@$(UV) venv --quiet --clear --python 3.11 .venv-lowest
	@$(UV) pip install --quiet --python .venv-lowest --resolution lowest-direct -e ".[$(EXTRAS)]" --group test
	@# What they import in turn is new, and warns them.
	@.venv-lowest/bin/$(PYTEST) --quiet -W ignore::DeprecationWarning $(OTHERS)

versions: $(READY)  ## Run the same on every other Python that is found, with constraints.txt
	@for version in $(VERSIONS); do \
	  path="$$PATH$$(printf ':%s' $(PYENV)/$$version*/bin)"; \
	  if ! python=$$(PATH="$$path" $(UV) python find --system $$version 2>/dev/null); then \
	    echo "Python $$version: NOT TESTED, there is none here"; \
	    continue; \
	  fi; \
	  echo "Python $$version: $$("$$python" $(VERSION))"; \
	  $(UV) venv --quiet --clear --python "$$python" .venv-$$version && \
	  $(UV) pip install --quiet --python .venv-$$version --constraint constraints.txt -e ".[$(EXTRAS)]" --group test && \
	  .venv-$$version/bin/$(PYTEST) --quiet $(OTHERS) || exit 1; \
	done

package: $(READY)  ## Build wheel and source distribution into dist/, and try the wheel in an empty environment
	@$(BIN)/python .ci/package.py

platforms: $(READY)  ## Resolve the core for Linux, macOS and Windows with binary wheels only
	@$(BIN)/python .ci/platforms.py

check: $(READY)  ## Check style, format, types, import layers and plain English
	@$(BIN)/ruff check --quiet
	@$(BIN)/ruff format --check --quiet || { echo "Not formatted as agreed: run 'make format'."; exit 1; }
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-logo
	@$(BIN)/python docs/plain_english.py

format: $(READY)  ## Format the code and mend what can be mended automatically
	@$(BIN)/ruff check --fix-only
	@$(BIN)/ruff format

docs: $(READY)  ## Build the documentation into site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@$(BIN)/python docs/links.py
	@echo "Built: site/index.html"

bench: NAME = step
bench: $(READY)  ## Run a benchmark, as NAME="step --size 31"; without NAME what one step costs
	@$(BIN)/python -m benchmarks $(NAME)

experiment: NAME = --help
experiment: $(READY)  ## Run a study, as NAME="degenerate --quick"; without NAME list them
	@$(BIN)/python -m experiments $(NAME)

lock: $(READY)  ## Renew constraints.txt from pyproject.toml with the newest versions
	@$(UV) pip compile --quiet --upgrade --python-version 3.11 --group dev $(patsubst %,--extra %,$(subst $(comma), ,$(ALL_EXTRAS))) \
	  --no-header --no-annotate \
	  --output-file constraints.txt pyproject.toml
	@echo "Renewed constraints.txt: read the difference, then run 'make check test versions'."

clean:  ## Remove caches and build products (not .venv)
	@rm -rf build dist site htmlcov .coverage .coverage.* .hypothesis
	@rm -rf .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	@find src tests benchmarks experiments -type d -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true

# The stamp is younger than both files as long as the environment holds what they ask for.
$(READY): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || \
	  { echo "Found no '$(PYTHON)': install Python 3.11 or newer, or name yours with 'make PYTHON=...'."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "livepde needs Python 3.11 or newer, '$(PYTHON)' is" \
	         "$$($(PYTHON) -c 'import sys; print(sys.version.split()[0])'):" \
	         "name a newer one with 'make PYTHON=...'."; exit 1; }
	@if [ -z "$(RENEW)" ] && $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	  echo "Updating $(VENV)"; \
	else \
	  echo "Creating $(VENV) (about a minute, once)"; \
	  $(PYTHON) -m venv --clear $(VENV) || \
	    { echo "Python's venv module does not work here; on Debian and Ubuntu: apt-get install python3-venv."; exit 1; }; \
	fi
	@# The first pip that knows groups is younger than Python 3.11 and 3.12.
	@$(PIP) install "pip>=25.1"
	@$(PIP) install -c constraints.txt -e ".[$(ALL_EXTRAS)]" --group dev
	@touch $@
