# Two commands for a start: `make demo` and `make test`. Everything runs in a virtual environment of its own.
PYTHON ?= python3
VENV ?= .venv
EXTRAS ?= $(VENV)-extras
WORKERS ?= auto
BIN := $(VENV)/bin
RELEASE_PYTHONS ?= all
PIP = -m pip install --quiet --disable-pip-version-check -c constraints.txt
# A file's tests share what they render, so they stay in one process; the largest files come first (tests/conftest.py).
PYTEST = -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
TORCH = $(shell sed -n 's/^torch==//p' constraints.txt)

# Containers often forbid bytecode, and each process would compile a thousand modules again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo docs docs-commands docs-figures test test-all test-ci test-extras examples bench lint audit \
	hashed-constraints release-check format clean

help:
	@echo "make demo      install, run the overview experiment, print the page's path"
	@echo "make docs      build/manual: the manual as a site; a warning or a dead link is an error"
	@echo "make docs-commands  run the manual's commands as they stand; QUICK=--quick leaves out what takes minutes"
	@echo "make docs-figures  make the manual's tables of measured figures anew and compare; CHEAP=--cheap leaves out what takes minutes"
	@echo "make test      fast tests (4 to 10 minutes on 2 cores)"
	@echo "make test-all  all tests, the slow ones too"
	@echo "make test-extras  tests that need an extra, which it installs beside .venv, or another program"
	@echo "make test-ci   what CI runs beyond make test: the cases marked ci, and those of test-extras"
	@echo "make bench     speeds, as ratios within one run"
	@echo "make lint      ruff, mypy, import-linter"
	@echo "make audit     risky calls and known vulnerabilities (bandit, pip-audit), where these can run"
	@echo "make examples  run all examples, renew their pictures in the manual (under 4 minutes of processor time)"
	@echo "make release-check  wheel and sdist into dist/, each Python from 3.11 on tried; RELEASE_PYTHONS=this: one"
	@echo "make hashed-constraints  constraints.txt with the hashes of this platform's files, for a release"

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# Compiled here and by all cores, so that no command of the user's compiles; pip would do it by one.
$(VENV)/.installed: $(BIN)/python pyproject.toml constraints.txt
	$(BIN)/python $(PIP) --no-compile -e .
	$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib simtest || true
	@touch $@

$(VENV)/.tests: $(VENV)/.installed
	$(BIN)/python $(PIP) -e ".[test]"
	@touch $@

# The CPU build of torch comes from a wheel beside the registry or not at all: the registry's own drags in gigabytes of CUDA.
$(EXTRAS)/.extras: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(EXTRAS)
	$(EXTRAS)/bin/python $(PIP) -e ".[test,test-extras]"
	$(EXTRAS)/bin/python $(PIP) "torch==$(TORCH)+cpu" || \
		echo "no CPU build of torch $(TORCH) was found: tests that need it are skipped"
	@touch $@

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/python $(PIP) -e ".[docs]"
	@touch $@

$(VENV)/.benchmarks: $(VENV)/.installed
	$(BIN)/python $(PIP) -e ".[bench]"
	@touch $@

demo: $(VENV)/.installed
	$(BIN)/simtest validate overview

docs: $(VENV)/.docs
	rm -rf build/manual
	$(BIN)/python -m sphinx --fail-on-warning --quiet --builder html --doctree-dir build/doctrees docs build/manual
	$(BIN)/python -m studies.manual links build/manual

docs-commands: $(VENV)/.docs
	$(BIN)/python -m studies.manual commands $(QUICK) $(PAGES)

docs-figures: $(VENV)/.docs
	$(BIN)/python -m studies.manual figures $(CHEAP) $(PAGES)

# A few examples of each property; the others draw all.
test: $(VENV)/.tests
	SIMTEST_EXAMPLES=few $(BIN)/python $(PYTEST) -m "not slow and not ci"

test-all: $(VENV)/.tests
	$(BIN)/python $(PYTEST)

test-extras: $(EXTRAS)/.extras
	$(EXTRAS)/bin/python $(PYTEST) tests/extras

test-ci: $(EXTRAS)/.extras
	$(EXTRAS)/bin/python $(PYTEST) -m "ci or extra"

bench: $(VENV)/.benchmarks
	$(BIN)/python -m benchmarks

lint: $(VENV)/.tests
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

# Both tools live in an environment of their own; where they cannot be installed, a line says so and nothing fails.
$(VENV)-audit/.installed: $(VENV)/.installed
	$(PYTHON) -m venv $(VENV)-audit
	-$(VENV)-audit/bin/python -m pip install --quiet --disable-pip-version-check "bandit[toml]>=1.8" "pip-audit>=2.7" && touch $@

audit: $(VENV)-audit/.installed
	$(VENV)-audit/bin/python .ci/audit.py

hashed-constraints: $(VENV)/.installed
	$(BIN)/python .ci/hashed_constraints.py

format: $(VENV)/.tests
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# The pictures of the manual are those that the examples make.
# One of them trains a network, so all extras are installed, and PyTorch where its CPU build is found.
examples: $(EXTRAS)/.extras
	for script in examples/[0-9]*.py; do $(EXTRAS)/bin/python $$script || exit 1; done
	cd examples && for notebook in *.ipynb; do $(abspath $(EXTRAS))/bin/python run_notebook.py $$notebook || exit 1; done
	for example in examples/[0-9]*; do \
		name=$$(basename $${example%.*}); picture=$$(ls examples/output/$$name.*); \
		cp $$picture docs/images/examples/$$(echo $$name | cut -c1-2).$${picture##*.}; \
	done

# Wheel and sdist, used outside the checkout in a fresh environment of each Python on the machine, or of this one alone.
release-check: $(BIN)/python
	$(BIN)/python .ci/release_check.py --pythons $(RELEASE_PYTHONS) $(RELEASE_OPTIONS)

clean:
	rm -rf $(VENV) $(EXTRAS) $(VENV)-audit reports/runs .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
