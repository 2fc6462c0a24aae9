# Every target does its own set-up; all that has to be there is Python >= 3.11 and make.
PYTHON ?= python3
PY := .venv/bin/python
WORKERS ?= 2
# One thread a test worker: two workers on two cores do not fight over them. Compiled modules are kept, even where the
# environment says otherwise: many tests start a Python of their own, which would compile the package again (0.6 s).
ENV := OMP_NUM_THREADS=1 MPLBACKEND=Agg PYTHONDONTWRITEBYTECODE=
# Each worker takes tests that stand side by side, so that few fixtures of a module are made twice.
SPREAD := -n $(WORKERS) --dist worksteal

.PHONY: demo docs tutorials judge lint check test test-anywhere test-pythons test-slow coverage mutants fuzz faults supply census clean

# $(1): what is installed beside the package's own requirements
define install
	@$(PYTHON) -c 'import sys; sys.exit("herglotz needs Python >= 3.11, this is " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	@[ -x $(PY) ] || $(PYTHON) -m venv .venv
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.$(1)'
endef

.venv/runtime: pyproject.toml constraints.txt
	$(call install,)
	@touch $@

.venv/installed: pyproject.toml constraints.txt
	$(call install,[dev])
	@touch .venv/runtime $@

.venv/site: pyproject.toml constraints.txt
	$(call install,[docs])
	@touch .venv/runtime $@

demo: .venv/runtime
	$(ENV) $(PY) -m herglotz fit data/demo_pendulum.csv --out runs/demo
	$(ENV) $(PY) -m herglotz export runs/demo --out runs/demo/stepper.pt2
	$(ENV) $(PY) -m herglotz verify runs/demo
	$(ENV) $(PY) -m herglotz verify runs/demo/stepper.pt2

# The documentation site, in build/site; `make tutorials` executes the scripts of its tutorials again (minutes).
docs: .venv/site
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --quiet

tutorials: .venv/runtime
	$(ENV) $(PY) tools/pages.py

# What the default fit is worth: cases, measured sets, laws that no dictionary holds, the zoo, many coordinates. It can be
# stopped and goes on where it was; CONTRIBUTING.md has what its rows are, and how two tables are compared.
judge: .venv/runtime
	$(ENV) $(PY) benchmarks/judge.py --workers $(WORKERS)

lint: .venv/installed
	$(PY) -m ruff check .
	$(PY) -m pyright --threads $(WORKERS)

# $(1): tests, all where it is empty. The types are checked beside the first of them: alone they would leave a core idle
# for most of a minute.
define checked
	$(PY) -m ruff check .
	$(PY) -m pyright & types=$$!; $(ENV) $(PY) -m pytest -q $(SPREAD) $(1); tests=$$?; wait $$types && exit $$tests
endef

# Before a commit: one to two minutes on two cores. Processor time, measured on an Intel Xeon with one worker: 127 s in
# all, pyright and 2383 tests. Folders left out: theory 48 s, plots 38 s, cli 83 s, export 194 s, and longer ones.
QUICK := tests/unit/*.py tests/unit/data tests/unit/mechanics tests/unit/models tests/golden tests/contracts
check: .venv/installed
	$(call checked,$(QUICK))

test: .venv/installed
	$(call checked,)

# Other instructions, threads, versions and roundings, each on the folders that it can change: three times as long as
# `make test`, folder by folder; it can be stopped and goes on where it was.
test-anywhere: .venv/installed
	$(PY) tests/anywhere.py

# The suite on every Python that is supported and installed here, and with the oldest and newest numpy and matplotlib,
# each in an environment of its own.
test-pythons: .venv/installed
	$(PY) tests/anywhere.py --only python3.11 python3.12 python3.13 oldest newest

test-slow: .venv/installed
	$(ENV) $(PY) -m pytest -q -m slow

# Branches of the package that the tests take; below each file, the lines and branches left out. Twice as long as
# `make test`. A test that fails under coverage, which slows Python down, does not stop the report.
coverage: .venv/installed
	@mkdir -p build/coverage
	$(PY) -m coverage erase
	-$(ENV) $(PY) -m coverage run -m pytest -q $(SPREAD)
	$(PY) -m coverage combine --quiet
	$(PY) -m coverage report --fail-under 92

# Break the package place by place: 40 mutants a room, each to be noticed by the tests of its own room. It can be
# stopped and goes on where it was; CONTRIBUTING.md has what was noticed.
mutants: .venv/installed
	$(ENV) $(PY) tests/mutants.py

# Damage every kind of file: ten minutes; counts of tried, refused, executed, silently wrong. A slice is in the tests.
fuzz: .venv/installed
	$(ENV) PYTHONPATH=. $(PY) tests/fuzz.py

# Strike a fit 900 times: killed, ended, without disk, memory or permission, its workers killed or stopped; counts of what
# was made good. About ten minutes of processor time, and as long again of waiting, by 108 strikes; a slice is in the
# slow tests.
faults: .venv/installed
	$(ENV) PYTHONPATH=. $(PY) tests/faults.py

# What is installed with it: licences, build/sbom.json, the hashes of lock.txt, and the README's example with the wheel
# and its requirements alone. Half a minute of processor time; pip fetches what it has not in its cache.
supply: .venv/installed
	$(PY) tools/supply.py sbom
	$(PY) tools/supply.py check-lock
	$(ENV) $(PY) -m pytest -q -m "" tests/unit/test_supply.py

# Lines a room, long functions, complexity, import circles.
census: .venv/installed
	$(PY) tools/census.py

clean:
	rm -rf .venv runs build dist .pytest_cache .ruff_cache
