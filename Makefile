# Every target makes what it needs: `make demo` and `make test` work in a fresh clone with nothing but Python 3.11+.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= demo
comma := ,
TEST_PROCESSES ?= 2
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt
# All extras of users but `croissant`, which is part of `dev`, and `rerun`, whose one test is skipped without it.
EXTRAS := cluster,dufomap,formats,genz,gpu,kiss,m3c2,octomap,odometry,ouster,parquet,view
LOWEST := .venv-lowest
NEWEST := .venv-newest
AUDIT := .venv-audit
MUTANTS := .venv-mutants
EVO := .venv-evo
PYTHONS ?= python3.11 python3.13
# One process per core and one thread in each; the tests of one file stay in one process and share what it has set up.
# Files begin in the order of tests/conftest.py, the long ones first.
PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder

FUZZ_INPUTS ?= 100000

.PHONY: setup demo test test-lowest lowest test-newest test-pythons test-evo audit fuzz soak load sweep mutants check report clean

setup: $(VENV)/.installed-dev

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "error: $(PYTHON) is older than 3.11: name a newer one with make PYTHON=python3.12" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 2; }

$(VENV)/.installed: $(BIN)/python pyproject.toml constraints.txt
	$(PIP) --editable .
	touch $@

# one installation, which is that of `make demo` too
$(VENV)/.installed-dev: $(BIN)/python pyproject.toml constraints.txt
	$(PIP) --editable '.[dev,$(EXTRAS)]'
	touch $(VENV)/.installed $@

demo: $(VENV)/.installed
	$(BIN)/tunnelcd demo --out $(OUT)

test: $(VENV)/.installed-dev
	$(PYTEST)

# All tests with the oldest versions that pyproject.toml allows of what is required and of EXTRAS. Old packages that warn
# of one another are no failure, nor are sockets that an old distributed leaves to the garbage collector.
test-lowest: $(LOWEST)/.installed
	OMP_NUM_THREADS=1 $(LOWEST)/bin/python -m pytest -n $(TEST_PROCESSES) --dist loadfile \
		-W default::DeprecationWarning -W default::PendingDeprecationWarning \
		-W default::pytest.PytestUnraisableExceptionWarning

$(LOWEST)/.installed: pyproject.toml .constraints-lowest.txt
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip --disable-pip-version-check install --quiet --constraint .constraints-lowest.txt \
		--editable '.[test,$(EXTRAS)]'
	touch $@

# Write .constraints-lowest.txt again, after a bound in pyproject.toml has moved.
lowest: $(BIN)/python
	$(BIN)/python -m pip --disable-pip-version-check install --quiet uv
	$(BIN)/uv pip compile pyproject.toml --quiet --upgrade --resolution lowest-direct --python-version 3.11 --only-binary :all: \
		$(foreach extra,test $(subst $(comma), ,$(EXTRAS)),--extra $(extra)) \
		--no-annotate --custom-compile-command 'make lowest' --output-file .constraints-lowest.txt

# All tests with the newest versions of these, on the day of the installation.
test-newest: $(NEWEST)/.installed
	OMP_NUM_THREADS=1 $(NEWEST)/bin/python -m pytest -n $(TEST_PROCESSES) --dist loadfile

$(NEWEST)/.installed: pyproject.toml
	$(PYTHON) -m venv $(NEWEST)
	$(NEWEST)/bin/python -m pip --disable-pip-version-check install --quiet --upgrade --upgrade-strategy eager \
		--editable '.[test,$(EXTRAS)]'
	touch $@

# Plan smoke on each of PYTHONS with the pinned packages: answers and rows are equal to the byte.
test-pythons: $(VENV)/.installed $(PYTHONS:%=.venv-%/.installed)
	rm -rf out/pythons
	for python in $(PYTHONS); do .venv-$$python/bin/tunnelcd run smoke --out out/pythons/$$python --quiet || exit; done
	for python in $(wordlist 2,9,$(PYTHONS)); do \
		$(BIN)/python tests/same_numbers.py out/pythons/$(firstword $(PYTHONS)) out/pythons/$$python || exit; done

$(PYTHONS:%=.venv-%/.installed): .venv-%/.installed: pyproject.toml constraints.txt
	$* -m venv .venv-$*
	.venv-$*/bin/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt --editable .
	touch $@

# evo reads our trajectories. Its environment is its own: it is GPL, and needs a newer rosbags than the pinned one.
test-evo: $(VENV)/.installed-dev $(EVO)/.installed
	TUNNELCD_EVO=$(EVO)/bin $(BIN)/python -m pytest tests/eval/converting/test_evo.py

$(EVO)/.installed:
	$(PYTHON) -m venv --clear $(EVO)
	$(EVO)/bin/python -m pip --disable-pip-version-check install --quiet evo==1.38.1
	touch $@

# Licences of all packages, and known vulnerabilities among the pins; the latter need a network.
audit: $(VENV)/.installed-dev $(AUDIT)/.installed
	$(AUDIT)/bin/python tests/audit.py $(BIN)/python

$(AUDIT)/.installed: constraints.txt
	$(PYTHON) -m venv $(AUDIT)
	$(AUDIT)/bin/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt \
		pip-audit pip-licenses
	touch $@

# Execute the notebooks. Then kill and disturb a plan and COMMANDS of tests/soak, for MINUTES; nothing may be lost.
# The table is SOAK/soak.md.
MINUTES ?= 30
SOAK ?= soak
soak: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m soak tests/eval/notebooks
	$(BIN)/python -m tests.soak --minutes $(MINUTES) --out $(SOAK)

# Peak memory and time of 10 km of tunnel, of 1,000 changes and of a plan of 5,000 cells.
load: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.trust.load

# The broad sweeps that `make test` leaves out.
sweep: $(VENV)/.installed-dev
	$(PYTEST) -m soak

# Mutants of the code that computes scores: a test kills each, or tests/mutants.yaml says why none can. mutmut has an
# environment of its own, as it needs a newer click than the pinned one.
mutants: $(MUTANTS)/.installed
	OMP_NUM_THREADS=1 $(MUTANTS)/bin/python tests/mutants.py --processes $(TEST_PROCESSES)

$(MUTANTS)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv --clear $(MUTANTS)
	$(MUTANTS)/bin/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt \
		--editable '.[test]'
	$(MUTANTS)/bin/python -m pip --disable-pip-version-check install --quiet mutmut==3.8.1
	touch $@

# Damaged files for every reader; fuzz/kept holds what was not read as it should, fuzz/table.md the counts.
fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m tests.trust.fuzz --inputs $(FUZZ_INPUTS) --processes $(TEST_PROCESSES) --keep fuzz --out fuzz/table.md

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

report: $(VENV)/.installed
	@[ -e $(OUT)/provenance.json ] || { echo "error: $(OUT) is no run: make demo first, or name one with make report OUT=..." >&2; exit 2; }
	$(BIN)/tunnelcd report $(OUT)

clean:
	rm -rf mutants $(VENV) $(LOWEST) $(NEWEST) $(AUDIT) $(MUTANTS) $(EVO) .venv-python* build *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
