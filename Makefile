# make demo    install, run the whole pipeline on a small dataset, say where the report is
# make test    install with the test tools, run the default tests
# make test-slow     the tests that take minutes
# make test-browser  install with playwright, open every page in Chromium
# make check   formatting, lint, types, and the order of imports
# make format  put formatting and imports right
# make drawing write the drawing of the rooms and the map of the files into CONTRIBUTING.md
# make deploy  register the flows with a running Prefect server
# make clean   delete what was installed and built, not datasets

PYTHON ?= python3
DATASET ?= data/demo
PRESET ?= demo
WORKERS ?= $(shell nproc)
# One process compiles the solvers first, the other has tests meanwhile that need none.
FIRST := planner rendering sampling scene store models structure
TESTS ?= $(FIRST:%=tests/test_%.py) $(wildcard tests/test_*.py)

BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# --no-compile: byte code is made when a module is first used, which saves a minute here.
COMPILE := $(BIN)/python -c "import relevance.planner; relevance.planner.warm_up()"

.PHONY: demo test test-slow test-browser check format drawing deploy clean
.DELETE_ON_ERROR:

# What the demo tells Prefect stays in this folder. Killed or done, it may be run again: finished
# shards, the last training state and the evaluated shards are taken up.
demo: .venv/installed
	PREFECT_HOME="$(CURDIR)/.prefect" $(BIN)/relevance demo \
		--dataset "$(DATASET)" --preset "$(PRESET)" --workers "$(WORKERS)"

# One thread a process: two test processes share the cores.
test: .venv/installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --durations 10 $(TESTS)

test-slow: .venv/installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m slow --durations 10 $(TESTS)

# Chromium is the system's (apt-get install chromium); what it saw is in build/screenshots.
test-browser: .venv/installed-browser
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m browser --durations 10 tests/test_browser.py tests/test_view_browser.py

check: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/python -m pytest -q tests/test_structure.py

format: .venv/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

drawing: .venv/installed-dev
	$(BIN)/python tests/structure.py

deploy: .venv/installed
	$(BIN)/prefect work-pool inspect relevance >/dev/null 2>&1 \
		|| $(BIN)/prefect work-pool create relevance --type process
	$(BIN)/prefect --no-prompt deploy --all

# Some Debian systems have no ensurepip; then the system's pip fills the environment.
.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed")'
	rm -rf .venv
	$(PYTHON) -m venv .venv || ( rm -rf .venv && $(PYTHON) -m venv --without-pip .venv \
		&& $(PYTHON) -m pip --python .venv/bin/python install --quiet pip )
	$(PIP) install --upgrade pip  # the one that Python 3.11 brings is slower by a third

.venv/installed: pyproject.toml | .venv/bin/python
	$(PIP) install --no-compile -e .
	$(COMPILE)  # so that nobody's first plan waits for it; the tests begin with some that need none
	touch $@

.venv/installed-dev: pyproject.toml | .venv/bin/python
	$(PIP) install --no-compile -e ".[dev]"
	touch .venv/installed $@

.venv/installed-browser: .venv/installed-dev
	$(PIP) install --no-compile -e ".[browser]"
	touch $@

clean:
	rm -rf .venv .prefect .pytest_cache .ruff_cache .hypothesis build dist
