# make map     a trajectory, a map and pictures; without SCANS, of a simulated world
# make check   formatting, lint, types and tests
# Both create .venv when it is missing and install what they need; a second call starts at once.
# The Python to use may be named: make check PYTHON=python3.12

PYTHON ?= $(shell command -v python3.11 || command -v python3)
SCANS ?=
OUT ?= out/map
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install map check format clean

help:  ## show the targets
	@grep -hE '^[a-z]+:.*##' $(firstword $(MAKEFILE_LIST)) | sed -E 's/:.*## /\t/' | expand -t 12

install: $(INSTALLED)  ## create .venv and install everything into it

map: $(INSTALLED)  ## map SCANS=folder into OUT=folder (default: a simulated world into out/map)
	$(BIN)/python -m train map $(if $(SCANS),"$(SCANS)") --out "$(OUT)"

check: $(INSTALLED)  ## formatting, lint, types and tests
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy bbr_layer models train
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

format: $(INSTALLED)  ## let ruff format and sort what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:  ## remove .venv, out/ and the caches
	rm -rf $(VENV) out build dist .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(INSTALLED): pyproject.toml constraints.txt
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo "Python 3.11 or newer is needed; name one with PYTHON=..., as in: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 2; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || "$(PYTHON)" -m venv --clear $(VENV)
	@echo "Installing into $(VENV): once, and a few minutes where torch has to be downloaded."
	@# --no-compile: what is imported is compiled then; to compile everything here takes long, and most is never imported.
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[train,las,dev]'
	@touch $@
