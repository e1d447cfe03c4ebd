# Two commands on a fresh machine: make demo, make test. Each makes .venv on first use and installs what it needs.
PYTHON ?= python3
BENCH ?= montecarlo
PYTEST_ARGS ?=
INSTALL = $(BIN)/python -m pip install -qq --no-compile
VENV := .venv
BIN := $(VENV)/bin
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
export PIP_DISABLE_PIP_VERSION_CHECK = 1
unexport PYTHONDONTWRITEBYTECODE  # tests start hundreds of processes; each would compile all it imports

.NOTPARALLEL:  # one pip at a time
.PHONY: demo test check bench docs dist constraints install clean
demo: $(VENV)/.user
	$(BIN)/vical demo --out demo_out

test: $(VENV)/.test
	$(BIN)/python -m pytest -n auto --dist loadfile --no-loadscope-reorder -q $(PYTEST_ARGS) tests

check: $(VENV)/.check  # imports early: the tests of .ci/run, next to it, find their bytecode
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python .ci/import_everything.py
	$(BIN)/mypy
	PYTHONPATH=. $(BIN)/lint-imports --no-cache
	$(BIN)/python .ci/constraints.py check

bench: $(VENV)/.user
	$(BIN)/python -m benchmarks $(BENCH)

docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -W -q -b html docs docs/_build/html

dist: $(VENV)/.dist  # wheel and sdist in dist/
	rm -rf dist
	$(BIN)/python -m hatchling build

constraints: $(VENV)/.check
	$(BIN)/python .ci/constraints.py write $(ARGS)

install: $(VENV)/.user
# .venv/.GROUP: the packages of that extra of pyproject.toml are in (user: what runs vical, and nothing else).
$(VENV)/.user $(VENV)/.test $(VENV)/.check $(VENV)/.docs $(VENV)/.dist: $(VENV)/.%: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "vical needs Python 3.11 or newer; try: make PYTHON=python3.12"; exit 1; }
	@$(BIN)/python -c '' 2>/dev/null || $(PYTHON) -m venv --clear $(VENV) || { echo "cannot make $(VENV); on Debian and Ubuntu: apt install python3-venv"; exit 1; }
	@echo "Installing into $(VENV): $* (once, about a minute) ..."
	@$(INSTALL) --constraint constraints.txt --editable '.$(patsubst %,[%],$(filter-out user,$*))'
	@touch $(VENV)/.user $@

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache demo_out docs/_build dist
