# `make run`: the whole work once; `make test`: the tests that take a minute. Both set up what they need in .venv.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
READY = $(VENV)/.ready
# Byte code is kept, whatever the user's shell says, and beside no source: tests start Pythons by the dozen.
export PYTHONPYCACHEPREFIX = $(abspath $(VENV))/byte_code
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test system slow robots lint format readers dask campaign draw clean

run: $(READY)
	$(BIN)/valve-drake run $(ARGS)

test: $(READY)
	$(BIN)/python -m pytest -n auto --dist loadfile

# The tests of the program at work: parts of runs, lessons, campaigns, twins, experiments.
system: $(READY)
	$(BIN)/python -m pytest -n auto --dist loadfile -m system

slow: $(READY)
	$(BIN)/python -m pytest -m slow

# Robots of two wheels (160 MB) through import-robot; those that cannot be installed are skipped.
robots: $(READY)
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[robots]'
	$(BIN)/python -m pytest -m robots -rs

# What ruff and mypy say of the code; `make format` mends what ruff can.
lint: $(READY) $(VENV)/.lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY) $(VENV)/.lint
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Other people's readers on a log (LOG=FILE, else on a run made for it); those that cannot be installed are skipped.
readers: $(READY)
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[readers]'
	-npm install --fetch-retries=0 --silent --no-audit --no-fund --no-package-lock --prefix tests/readers
	LOG=$(LOG) $(BIN)/python -m pytest -m readers -rs

# A short campaign, and the hardest draws that were found: fails if a valve is not turned.
RUNS ?= 6
campaign: $(READY)
	rm -rf logs/ci-campaign logs/ci-again
	$(BIN)/valve-drake campaign --runs $(RUNS) --jobs 2 --out logs/ci-campaign
	$(BIN)/valve-drake campaign --again tests/failures.yaml --runs 2 --jobs 2 --out logs/ci-again

# Campaigns on Dask's workers; skipped if it cannot be installed.
dask: $(READY)
	-$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dask]'
	$(BIN)/python -m pytest -n 0 -rs tests/test_campaign.py -k "dask or worker"

draw: $(READY)
	$(BIN)/valve-drake draw

$(READY): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing: install python3 (3.11 or newer)"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed, $(PYTHON) is $$($(PYTHON) -V 2>&1): set PYTHON=python3.11"; exit 2; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "the venv module is missing: install it (Debian, Ubuntu: apt-get install python3-venv)"; exit 2; }
	@$(PYTHON) -c 'import ctypes; ctypes.CDLL("libEGL.so.1")' 2>/dev/null || \
	  { echo "libEGL.so.1 is missing: install it (Debian, Ubuntu: apt-get install libegl1)"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@

$(VENV)/.lint: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[lint]'
	@touch $@

clean:
	rm -rf $(VENV) build *.egg-info logs/run-*
