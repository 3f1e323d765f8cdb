# make demo    train and relight the built-in character: out/demo
# make test    all tests
# make check   format, lint and types
# make bench   all benchmarks: out/benchmarks.json
# make clean   remove .venv and out
#
# Each makes .venv with python3 (or PYTHON=...), installs from constraints.txt once, and does its work.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt
METADATA := setup.cfg pyproject.toml constraints.txt

.PHONY: demo test check bench clean

demo: $(VENV)/.demo
	$(BIN)/jaxrender demo

test: $(VENV)/.dev
	$(BIN)/python -m pytest -n auto --dist loadfile

check: $(VENV)/.dev
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy

bench: $(VENV)/.dev
	$(BIN)/python -m benchmarks run

clean:
	rm -rf $(VENV) out

# Stamps: a second call finds everything in place. The packages are linked to this folder, so a change of
# the source needs no new installation.
$(VENV)/.demo: $(VENV)/.made $(METADATA)
	@echo "installing jaxrender into $(VENV) (some minutes, once)"
	@$(PIP) -e '.[plots]'
	@touch $@

$(VENV)/.dev: $(VENV)/.made $(METADATA)
	@echo "installing jaxrender and its development tools into $(VENV) (some minutes, once)"
	@$(PIP) -e '.[dev]'
	@touch $@ $(VENV)/.demo

# Some systems ship venv without its copy of pip; the pip that is there can then install another.
$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "jaxrender needs Python 3.11 or newer; $(PYTHON) is `$(PYTHON) -V 2>&1`. Try: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV) 2>/dev/null || \
	  { $(PYTHON) -m venv --clear --without-pip $(VENV) && $(PYTHON) -m pip --python $(BIN)/python install -qq pip; }
	@touch $@
