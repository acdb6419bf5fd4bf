# Every target builds .venv first if it is missing or older than what it is built from.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
# One thread per process: parallel work is in processes, and threads that wait for each other on shared cores crawl.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
unexport PYTHONDONTWRITEBYTECODE # each of many processes would compile all modules anew
STAMP := .venv/.installed
BIN := .venv/bin

.PHONY: help demo test test-runs test-carla test-deployed test-planner test-peers test-ray lint docs check bench bench-peers format clean
help: # Print the targets with what they do
	@sed -n 's/^\([a-z-]*\):[^#]*# /\1\t/p' $(MAKEFILE_LIST) | expand -t 14

demo: $(STAMP) # Run the demo, 8 minutes: out/demo/report.html
	$(BIN)/flcav demo --out out/demo

test: $(STAMP) # Run the tests, 8 minutes on 2 cores
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow"

# Whole pipelines at toy scale: runs of all recipes and examples, stopped and killed ones, the installed wheel, studies; and
# the tests that take longest of others: coverage of intervals, optima against all plans, full disks.
test-runs: $(STAMP) # Run whole pipelines at toy scale
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m slow

# Exports read by other software, in environments of their own below out/peers: docs/formats.md.
test-peers: $(STAMP) # Read exports by other software
	$(BIN)/python -m pytest -n 0 -rs tests/peers

# Recordings from `flcav carla serve`, and CARLA's own scripts and those of others against it, in an environment of their
# own, out/carla; they and the maps are in the folder of FLCAV_REAL_DATA, and without it these tests are skipped: docs/carla.md.
test-carla: $(STAMP) # Run CARLA's scripts against `flcav carla serve`
	$(BIN)/python -m pytest -n 0 -rs tests/carla_clients

# A fleet that is up: its refusals, its kills, its weights; docs/fleet.md. Tests of several hosts make network namespaces,
# and are skipped where that is not permitted.
test-deployed: $(STAMP) # Test a fleet that is up
	$(BIN)/python -m pytest -n 0 -rs tests/deployed

# The planner in Debian's Chromium; `npm ci` in src/flcav/planner/web gives it axe and esbuild. What is missing is skipped.
test-planner: $(STAMP) # Test the planner in a browser
	$(BIN)/python -m pytest -n 0 -rs tests/planner

# What runs on Ray beside what runs without it, in an environment of its own with the extra 'ray', below out/ray.
test-ray: # Test what runs on Ray
	test -x out/ray/bin/python || $(PYTHON) -m venv out/ray
	out/ray/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,fusion,towns,ray]"
	out/ray/bin/python -m pytest -n 0 -rs -k "on_ray or ray_cluster" tests/integration

lint: $(STAMP) # Check style, layers and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/pyright

# The site, out/docs/index.html. Only pages that changed are read anew; whatever Sphinx warns of is an error. It installs
# only where there is nothing yet: an environment that other checkouts share keeps its install.
docs: # Build the site: out/docs/index.html
	test -x $(BIN)/sphinx-build || $(MAKE) $(STAMP)
	rm -rf out/docs
	$(BIN)/python -m sphinx -b html -c docs -d out/doctrees --fail-on-warning --keep-going --quiet . out/docs
	$(BIN)/python tools/check_site.py out/docs

check: lint docs test # Lint, build the site, run the tests

bench: $(STAMP) # Run all benchmarks
	for b in benchmarks/bench_*.py; do $(BIN)/python $$b || exit 1; done

# A federated round of pfl and of Flower's simulation beside ours, in an environment below out/peers.
bench-peers: $(STAMP) # Compare a federated round with pfl and Flower's simulation
	$(BIN)/python benchmarks/peers/compare.py

format: $(STAMP) # Format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" || { echo "flcav needs Python 3.11 or newer: make PYTHON=python3.x"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[carla,dev,docs,fusion,gym,releases,ros,towns]"
	touch $(STAMP)

clean: # Remove .venv and out
	rm -rf .venv out
