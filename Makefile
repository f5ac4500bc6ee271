# Needs python3 (3.11 or newer) and pip; everything else is installed into .venv here.
#   make demo          simulate a drive, calibrate it offline and on the live node, compare with the truth
#   make test          the test suite, without the tests of the next line
#   make test-statistics  tests that judge errors and sigmas of many recordings
#   make test-oldest   make test on the oldest supported versions
#   make fuzz          5,400 files, damaged on purpose (INPUTS=500)
#   make lint          style, types and the contracts of the layers
#   make coverage      all tests, and the lines that no test runs
#   make paper DATA=x  every figure and table of the paper from its published data in x, to reproduced/
#   make coverage-study DATA=x  errors over their lower bound, and what the stated sigmas are worth
#   make gate DATA=x   did errors or stated uncertainties get worse than the stored baseline? Five
#                      minutes; x, the published data, may be left out (GATE_ARGS=--update stores)
#   make gate-quick    the same on fewer recordings; one minute
#   make bench         benchmarks against the baseline; two minutes (BENCH_ARGS=--full: four)
#   make bench-node    load, soak and crashes of the node; about four minutes
#   make sessions      twelve live sessions of the node, and whether all its surfaces agree; 20 minutes
#                      (SESSIONS='"knock" "parked"' for some)
#   make dist          wheel and sdist in dist/, checked (RELEASE=1: only if nothing is a placeholder)
#   make try-dist      make dist, then install wheel and sdist in clean environments and calibrate
#   make tested        write requirements/tested.txt: the versions in .venv
#   make docs          the documentation site in site/; its links, and every command on its pages, are
#                      tried; nothing is fetched
#   make notebook      run the notebooks of examples/ again and keep their outputs
#   make clean         remove everything that the targets above made
# PYTHON=python3.12 chooses the interpreter, PYTEST_ARGS="-k name" goes to pytest, WORKERS=1 is the
# number of tests that run at once: by default one a core, and one for tests that start nodes.
PYTHON ?= python3
PYTEST_ARGS ?=
WORKERS ?= auto
BENCH_ARGS ?=
PAPER_ARGS ?=
FUZZ_ARGS ?=
STUDY_ARGS ?=
GATE_ARGS ?=
DATA ?=
DEMO_ARGS ?= --out demo_output
RELEASE ?=

# What is compiled once is not compiled again by each process of a test.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
OLDEST := .venv-oldest
PIP_FLAGS := --quiet --disable-pip-version-check
PYTEST := python -m pytest --numprocesses $(WORKERS)
SETUP_FILES := setup.py setup.cfg pyproject.toml package.xml

.PHONY: help demo test test-statistics test-oldest coverage coverage-study fuzz gate gate-quick paper bench \
	bench-node sessions lint format dist try-dist tested docs notebook clean

help:
	@sed -n 's/^#   //p' Makefile

demo: $(VENV)/.ready-demo
	$(VENV)/bin/hand_eye_calib demo $(DEMO_ARGS)

# One thread per process: small matrices gain nothing from more, and results do not depend on the
# number of cores.
test test-statistics test-oldest coverage coverage-study gate paper: export OMP_NUM_THREADS := 1
test test-statistics test-oldest coverage coverage-study gate paper: export OPENBLAS_NUM_THREADS := 1

test: $(VENV)/.ready-test
	$(VENV)/bin/$(PYTEST) -m 'not statistics' $(PYTEST_ARGS)

test-statistics: $(VENV)/.ready-test
	$(VENV)/bin/$(PYTEST) -m statistics $(PYTEST_ARGS)

test-oldest: $(OLDEST)/.ready-test
	$(OLDEST)/bin/$(PYTEST) -m 'not statistics' $(PYTEST_ARGS)

coverage: $(VENV)/.ready-test
	$(VENV)/bin/$(PYTEST) --cov --cov-report=term:skip-covered $(PYTEST_ARGS)

fuzz: $(VENV)/.ready-test
	FUZZ_INPUTS=$(or $(INPUTS),5400) $(VENV)/bin/python -m pytest test/fuzz $(PYTEST_ARGS)

paper: $(VENV)/.ready-test
	$(VENV)/bin/python -m reproduction all $(if $(DATA),--data-folder $(DATA)) $(PAPER_ARGS)

coverage-study: $(VENV)/.ready-test
	$(VENV)/bin/python -m reproduction.coverage --page docs/coverage.md \
		$(if $(DATA),--data-folder $(DATA)) $(STUDY_ARGS)

gate: $(VENV)/.ready-test
	$(VENV)/bin/python -m reproduction.gate $(if $(DATA),--data-folder $(DATA)) $(GATE_ARGS)

gate-quick: GATE_ARGS += --quick
gate-quick: gate

bench: $(VENV)/.ready-bench
	OMP_NUM_THREADS=1 $(VENV)/bin/python benchmarks/run.py $(BENCH_ARGS)

bench-node: $(VENV)/.ready-test
	OMP_NUM_THREADS=1 $(VENV)/bin/python benchmarks/node_load.py $(BENCH_ARGS)

sessions: $(VENV)/.ready-test
	OMP_NUM_THREADS=1 $(VENV)/bin/python benchmarks/node_sessions.py $(SESSIONS)

lint: $(VENV)/.ready-test
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports --no-cache pyproject.toml

format: $(VENV)/.ready-test
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

dist: $(VENV)/.ready-release
	$(if $(RELEASE),! grep -n "\.example" package.xml)
	rm -rf dist
	$(VENV)/bin/python -m build --outdir dist .
	$(VENV)/bin/twine check --strict dist/*

try-dist: dist
	sh requirements/try_dist.sh dist

tested: $(VENV)/.ready-test
	{ echo "# Versions with which the tests have passed, written by make tested."; \
		$(VENV)/bin/python -m pip freeze --exclude-editable; } >requirements/tested.txt

# ruff breaks the lines of long signatures.
docs: export NO_MKDOCS_2_WARNING := 1
docs: export HAND_EYE_CALIB_ALL_PAGES := 1
docs: $(VENV)/.ready-docs
	PATH="$(CURDIR)/$(VENV)/bin:$$PATH" $(VENV)/bin/mkdocs build --strict --quiet
	$(VENV)/bin/python docs/check_site.py site
	$(VENV)/bin/python -m pytest test/project/test_docs.py $(PYTEST_ARGS)

notebook: $(VENV)/.ready-test
	$(VENV)/bin/python examples/run_notebooks.py

clean:
	rm -rf $(VENV) $(OLDEST) build install log dist site demo_output reproduced *.egg-info .coverage*
	rm -rf .pytest_cache .hypothesis .ruff_cache .mypy_cache
	find hand_eye_calib reproduction test benchmarks launch -name __pycache__ -type d -prune \
		-exec rm -rf {} +

# The package is installed editable: what runs and what is tested is this work tree. It is compiled
# here, as pip does with packages that are not editable: commands start faster. A stamp file is
# touched last, so that set-up is repeated if it was interrupted or a file it depends on is newer.
$(VENV)/.ready-demo: EXTRAS := ros
$(VENV)/.ready-test: EXTRAS := ros,camera,cluster,coverage,fleet,foxglove,lidar,notebook,px4,test,lint
$(OLDEST)/.ready-test: EXTRAS := ros,cluster,fleet,notebook,test
$(OLDEST)/.ready-test: CONSTRAINTS := --constraint requirements/oldest.txt
$(OLDEST)/.ready-test: requirements/oldest.txt

# What one target needs and nothing else does.
$(VENV)/.ready-bench $(VENV)/.ready-docs $(VENV)/.ready-release: $(VENV)/.ready-%: \
		$(VENV)/.ready-test requirements/%.txt
	@$(VENV)/bin/python -m pip install $(PIP_FLAGS) --requirement requirements/$*.txt
	@touch $@

$(VENV)/.ready-demo $(VENV)/.ready-test $(OLDEST)/.ready-test: $(SETUP_FILES)
	@PYTHON="$(PYTHON)" sh requirements/make_venv.sh $(@D)
	@echo "installing hand_eye_calib with [$(EXTRAS)] into $(@D)"
	@$(@D)/bin/python -m pip install $(PIP_FLAGS) $(CONSTRAINTS) --editable ".[$(EXTRAS)]"
	@$(@D)/bin/python -m compileall -q hand_eye_calib
	@touch $@
