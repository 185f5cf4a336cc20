# Two commands do all the set-up: `make demo` installs and runs the main job, `make test` installs and runs the tests.
PYTHON ?= $(firstword $(foreach minor,11 12 13,$(shell command -v python3.$(minor))) python3)
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: schemas bench-posterior calibrations relearn bench-forward bench-record demo test check lint long slow pages bench bench-map bench-trial docs clean

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

demo: $(VENV)/.installed
	$(BIN)/tactile-bayes demo -o demo-output --force

# Three minutes on two cores. Tests that take longer than most are marked `long` and run with `make check`.
test: $(VENV)/.installed
	$(BIN)/python -m pytest -n auto --dist worksteal

check: lint test long

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Ten minutes more. `PART="--begin-at N --budget S"` takes S seconds of it, from a place that N decides; so with `slow`.
long: $(VENV)/.installed
	$(BIN)/python -m pytest -m 'long and not slow' -n auto --dist worksteal $(PART)

# All of it: hours.
slow: $(VENV)/.installed
	$(BIN)/python -m pytest -m slow -n auto --dist worksteal $(PART)

# What a reader types from the pages, as printed: minutes.
pages: $(VENV)/.installed
	$(BIN)/python -m pytest -m '' -n auto -k test_a_page_runs_as_printed tests/test_docs.py

bench: $(VENV)/.installed
	$(BIN)/python -m benchmarks.run

# Peers and the compiler are no dependencies of the program: they are installed here only.
bench-map: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'boost-histogram>=1.4'
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.map_speed

bench-posterior: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check numpyro dynesty bumps
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.posterior

bench-record: $(VENV)/.installed
	$(BIN)/python -m benchmarks.record

bench-forward: $(VENV)/.installed
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.forward
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.solid

bench-trial: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check statsmodels pingouin
	$(BIN)/python -m benchmarks.trial

# The size calibrations that come with the program, made again: an hour and a half on two cores for the population's scans.
calibrations: $(VENV)/.installed
	mkdir -p build
	OPENBLAS_NUM_THREADS=1 $(BIN)/tactile-bayes population --masses 1500 --centred 750 --seed 7 --workers 2 \
		--normalise gain --normalise mean -o build/population.csv --force
	gzip -9 -n -c build/population.csv > validation/population.csv.gz
	$(MAKE) relearn

# The same from the scans' table as it is kept, and what lumps of another simulator say of it: two minutes.
relearn: $(VENV)/.installed
	mkdir -p build
	gzip -d -c validation/population.csv.gz > build/population.csv
	$(BIN)/tactile-bayes calibrate size build/population.csv --normalise gain --form eq6-residual \
		--against validation/other_simulator.csv -o tactile_bayes/calibrations/solid.json --force
	$(BIN)/tactile-bayes calibrate size build/population.csv --normalise mean --form eq6-residual \
		--against validation/other_simulator.csv -o tactile_bayes/calibrations/solid_mean.json --force
	$(BIN)/tactile-bayes calibrate size build/population.csv --normalise gain --form eq6 \
		--against validation/other_simulator.csv -o tactile_bayes/calibrations/eq6.json --force
	$(BIN)/tactile-bayes study -o build/paper_grid.csv --force
	$(BIN)/tactile-bayes calibrate size build/paper_grid.csv --fit-radius-mm 48 --least-stiffness-ratio 8 \
		-o tactile_bayes/calibrations/plane_strain.json --force

$(VENV)/.docs-installed: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	touch $@

# Schemas of files, command reference and columns, from the program; a test holds them together.
schemas: $(VENV)/.installed
	$(BIN)/python docs/make_reference.py

# The site, in build/site: a broken link, a page that is in no table of contents or any other warning fails.
docs: $(VENV)/.docs-installed
	$(BIN)/python docs/make_reference.py
	$(BIN)/python -m sphinx --builder html --jobs auto --fail-on-warning --nitpicky --keep-going docs build/site

clean:
	rm -rf $(VENV) build dist demo-output .mypy_cache .ruff_cache .pytest_cache .hypothesis
