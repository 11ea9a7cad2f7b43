# Two commands for a start: `make demo` and `make test`. Everything runs in a virtual environment of its own.
PYTHON ?= python3
VENV ?= .venv
WORKERS ?= auto
BIN := $(VENV)/bin
RELEASE_PYTHONS ?= all
# A file's tests share what they render, so they stay in one process; tests/conftest.py names the long files, which come first.
PYTEST = $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
TORCH := $(shell sed -n 's/^torch==//p' constraints.txt)

.PHONY: help demo docs docs-commands docs-figures test test-all test-ci examples bench bench-cycles lint audit hashed-constraints \
	release-check format clean

help:
	@echo "make demo      install, run the overview experiment, print the page's path"
	@echo "make docs      build/manual: the manual as a site; a warning or a dead link is an error"
	@echo "make docs-commands  run the manual's commands as they stand; QUICK=--quick leaves out what takes minutes"
	@echo "make docs-figures  make the manual's tables of measured figures anew and compare; CHEAP=--cheap leaves out what takes minutes"
	@echo "make test      fast tests (about 5 minutes on 2 cores)"
	@echo "make test-all  all tests, the slow ones too"
	@echo "make test-ci   fast tests, the cases of tests/slow_cases.py and those of all extras, which it installs"
	@echo "make bench     speeds, as ratios within one run"
	@echo "make bench-cycles  a labelled frame beside Blender's Cycles, which it installs (Python 3.11; 1 GB)"
	@echo "make lint      ruff, mypy, import-linter"
	@echo "make audit     risky calls and known vulnerabilities (bandit, pip-audit), where these can run"
	@echo "make examples  run all examples, renew their pictures in the manual (under 4 minutes of processor time)"
	@echo "make release-check  wheel and sdist into dist/, each Python from 3.11 on tried; RELEASE_PYTHONS=this: one"
	@echo "make hashed-constraints  constraints.txt with the hashes of this platform's files, for a release"

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(BIN)/python pyproject.toml constraints.txt
	@# Most modules are never imported: bytecode is made at first use.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e .
	@touch $@

$(VENV)/.tests: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test]"
	@touch $@

# The CPU build of torch comes from a wheel beside the registry or not at all: the registry's own drags in gigabytes of CUDA.
$(VENV)/.ci: $(VENV)/.tests
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test,ci]"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt "torch==$(TORCH)+cpu" || \
		echo "no CPU build of torch $(TORCH) was found: tests that need it are skipped"
	@touch $@

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	@touch $@

$(VENV)/.benchmarks: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[bench]"
	@touch $@

$(VENV)-cycles/.installed: benchmarks/cycles-requirements.txt
	$(PYTHON) -m venv $(VENV)-cycles
	$(VENV)-cycles/bin/python -m pip install --quiet --disable-pip-version-check -r benchmarks/cycles-requirements.txt
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
	SIMTEST_EXAMPLES=few $(PYTEST) -m "not slow"

test-all: $(VENV)/.tests
	$(PYTEST)

test-ci: $(VENV)/.ci
	$(PYTEST) -m "not slow or extra" -rs

bench: $(VENV)/.benchmarks
	$(BIN)/python -m benchmarks

# Blender's Cycles lives in an environment of its own: its package needs a NumPy older than ours, and Python 3.11.
bench-cycles: $(VENV)/.installed $(VENV)-cycles/.installed
	SIMTEST_CYCLES_PYTHON=$(VENV)-cycles/bin/python $(BIN)/python -m benchmarks blender

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
examples: $(VENV)/.ci
	for script in examples/[0-9]*.py; do $(BIN)/python $$script || exit 1; done
	for script in examples/[0-9]*.py; do \
		name=$$(basename $$script .py); picture=$$(ls examples/output/$$name.*); \
		cp $$picture docs/images/examples/$$(echo $$name | cut -c1-2).$${picture##*.}; \
	done

# Wheel and sdist, used outside the checkout in a fresh environment of each Python on the machine, or of this one alone.
release-check: $(BIN)/python
	$(BIN)/python .ci/release_check.py --pythons $(RELEASE_PYTHONS) $(RELEASE_OPTIONS)

clean:
	rm -rf $(VENV) $(VENV)-cycles $(VENV)-audit reports/runs .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
