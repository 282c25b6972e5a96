# make run and make test set everything up themselves; they need only Python 3.11, git and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
SPHINX := $(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --builder html
SITE := docs/_build/html
PYTEST := $(BIN)/python -m pytest -n auto --dist loadgroup

.PHONY: run test test-rest test-full test-slow lint docs docs-serve clean

# Trains, evaluates and tracks the default agent on phantom wrists; ARGS="projection=zy" changes what is run.
run: $(INSTALLED)
	$(BIN)/python -m armscan.run $(ARGS)

# Six to twelve minutes on two cores: no servers, clusters, browsers, or runs in separate processes.
test: $(INSTALLED)
	$(PYTEST) -m "not full and not slow" $(ARGS)

# The tests of `make test-full` that `make test` leaves out.
test-rest: $(INSTALLED)
	$(PYTEST) -m "full and not slow" $(ARGS)

test-full: $(INSTALLED)
	$(PYTEST) -m "not slow" $(ARGS)

test-slow: $(INSTALLED)
	$(BIN)/python -m pytest -m slow $(ARGS)

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	git ls-files -z | xargs -0 $(BIN)/codespell
	$(SPHINX) docs $(SITE)

# The documentation, in docs/_build/html; a broken link or reference is an error.
docs: $(INSTALLED)
	$(SPHINX) docs $(SITE)

docs-serve: docs
	$(BIN)/python -m http.server --bind 127.0.0.1 --directory $(SITE) 8000

clean:
	rm -rf $(VENV)

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[test]"
	touch $@
