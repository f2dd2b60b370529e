# Two commands: `make demo` and `make test`. Both set up .venv first.
PYTHON ?= python3.11
# Which tests: without those that take long, or `make test MARK=` for all, as CI does.
MARK ?= not slow
BIN := .venv/bin

.PHONY: setup demo test lint docs clean

setup: .venv/.ready

# Installed again when what is installed changes; constraints.txt pins the tested set.
.venv/.ready: pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "Python 3.11 is needed and '$(PYTHON)' is not on this machine; install it (Debian: apt-get install python3.11-venv) or say PYTHON=/path/to/python."; exit 2; }
	@$(PYTHON) -c "import ensurepip, venv" 2>/dev/null || { echo "'$(PYTHON)' cannot make virtual environments; on Debian: apt-get install python3.11-venv"; exit 2; }
	$(PYTHON) -m venv .venv
	@echo "Installing into .venv takes minutes, and 3 GB or, with torch's build for GPUs, more."
	$(BIN)/python -m pip install --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: setup
	$(BIN)/sceneprior demo

test: setup
	$(BIN)/python -m pytest -n 2 --dist loadscope -m "$(MARK)"

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# site/index.html opens from disk, and asks no network for anything.
docs: setup
	$(BIN)/python -m mkdocs build

clean:
	rm -rf .venv out runs build dist site
