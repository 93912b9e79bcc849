# Every target creates the environment that it needs. Only Python 3.11 or newer and make are required.
PYTHON ?= python3
VENV   := .venv
# On Windows, run make in a bash such as that of Git.
BIN    := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
PEERS  := $(subst $(VENV),$(VENV)-peers,$(BIN))
EXE    := $(if $(filter Windows_NT,$(OS)),.exe)
BASE   := $(VENV)/.base
STAMP  := $(VENV)/.installed
# Python compiles a module at its first import and caches the result. Compiling all modules during installation would
# take a third of its time. Some container images disable the cache, so that every process would compile again.
unexport PYTHONDONTWRITEBYTECODE
# The matrices are small, and idle threads of OpenBLAS use processor time while they wait.
export OPENBLAS_NUM_THREADS ?= 1
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

.PHONY: demo test lint types layers quick gauntlet fits matrix soak mutants bench peers docs clean
.DEFAULT_GOAL := demo

$(BIN)/python$(EXE):
	$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(0 if v >= (3, 11) else f"Python 3.11 or newer is needed, found {v.major}.{v.minor}: make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip

# The product alone, without tests, grains, clusters or linters.
$(BASE): pyproject.toml | $(BIN)/python$(EXE)
	$(PIP) -e .
	@touch $@

$(STAMP): pyproject.toml | $(BIN)/python$(EXE)
	$(PIP) -e ".[dev]"
	@touch $@ $(BASE)

demo: $(BASE)
	$(BIN)/analysis demo

test: $(STAMP) lint types layers
	$(BIN)/python -m tests.warm_up
	$(BIN)/python -m pytest -n 2 -q --durations=20

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

layers: $(STAMP)
	$(BIN)/lint-imports

# Fast tests for use during development: without complete tests on the rig, random ensembles and many figures.
quick: $(STAMP)
	$(BIN)/python -m tests.warm_up
	$(BIN)/python -m pytest -n 2 -q -m "not thorough"

# The analysis on hundreds of random scenes, on all cores; for other scenes: make gauntlet SEED=2 SCENES=600.
SEED ?= 1
SCENES ?= 300
gauntlet: $(STAMP)
	$(BIN)/python -m tests.warm_up
	$(BIN)/python -m tests.gauntlet --scenes $(SCENES) --seed $(SEED)

# Fits of scenes to recordings of random scenes.
fits: $(STAMP)
	$(BIN)/python -m tests.gauntlet.fits --seed $(SEED)

# The tests as on other machines: vector widths, numbers of threads, locales, Python versions, oldest dependencies. The
# quick tests run with every kernel of OpenBLAS.
matrix: $(STAMP)
	$(BIN)/python -m tests.matrix

# Hundreds of faults injected into commands: kills, damaged files, full disks, invalid input: make soak SEED=1000.
soak: $(STAMP)
	$(BIN)/python -m tests.soak --seed $(SEED)

# Mutation testing: small faults in the code, which the tests should detect: make mutants SEED=2.
mutants: $(STAMP)
	$(PIP) -e ".[dev,mutants]"
	$(BIN)/python -m tests.warm_up
	$(BIN)/python -m tests.mutants --seed $(SEED)

bench: $(STAMP)
	$(PIP) -e ".[dev,peers]"
	$(BIN)/python -m tests.benchmarks

# Comparison with independent packages, which are installed in a separate environment.
peers: $(STAMP)
	test -x $(PEERS)/python$(EXE) || $(PYTHON) -m venv $(VENV)-peers
	$(PEERS)/python -m pip install --quiet --disable-pip-version-check "pyFRF==1.5.0" "sdypy-EMA==0.31.0" "pyyeti==1.4.7"
	$(BIN)/python -m tests.peers.ours build/peers
	MPLBACKEND=agg $(PEERS)/python tests/peers/theirs.py build/peers

# The documentation as a site in build/docs: the pages of the guides, and the reference generated from the code.
docs: $(STAMP)
	$(PIP) -e ".[dev,docs]"
	mkdir -p build/docs-source
	$(BIN)/python -m sphinx -q -W --keep-going -c .docs build/docs-source build/docs
	@echo "open build/docs/index.html"

clean:
	rm -rf $(VENV) $(VENV)-peers build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
