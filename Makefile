# make setup | demo | test | test-full | docs | lint | format | clean        (make help says more)
#
# VENV     where the environment is made                    make test VENV=/tmp/kcreg
# PYTHON   what makes it, Python 3.10 or later              make test PYTHON=python3.12
# TORCH    which torch, 2.10 or later                       make test TORCH=torch==2.13.0
# TORCH_PIP_FLAGS   where from: pip's --index-url of the build without CUDA, say
# EXTRAS   what comes with the library                        make test EXTRAS=dev
# JOBS     processes that test side by side                 make test JOBS=8

VENV ?= .venv
PYTHON ?= python3
TORCH ?= torch>=2.10
TORCH_PIP_FLAGS ?=
EXTRAS ?= dev,docs,notebooks,simulate
JOBS ?= 2

BIN := $(VENV)/bin
STAMP := $(VENV)/.torchkcreg-is-installed
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet
SOURCES := $(wildcard torchkcreg/csrc/*.cpp torchkcreg/csrc/*.h torchkcreg/csrc/*/*.cpp torchkcreg/csrc/*/*.h)
PYTEST := OMP_NUM_THREADS=1 MPLBACKEND=Agg $(BIN)/python -m pytest -n $(JOBS) --doctest-modules torchkcreg tests

.PHONY: help setup demo test test-full docs lint format clean
.DEFAULT_GOAL := help

help:
	@echo "make setup      an environment in $(VENV) with the library and what its development needs"
	@echo "make demo       simulate a loaded plate, register it, evaluate and draw the result, into demo/"
	@echo "make test       quick tests and the examples in docstrings"
	@echo "make test-full  the slow tests too, and those against RTK"
	@echo "make docs       the documentation as a site, into site/; a broken link is an error"
	@echo "make lint       ruff, mypy, clang-format; changes nothing"
	@echo "make format     ruff and clang-format; changes files"
	@echo "make clean      remove what building and testing leave (demo/ and the environment stay)"

setup: $(STAMP)

# torch comes first: the C++ kernels are built against the torch that is installed.
$(STAMP): pyproject.toml setup.cfg setup.py $(SOURCES)
	$(PYTHON) -m venv $(VENV)
	$(PIP) $(TORCH_PIP_FLAGS) "$(TORCH)"
	$(PIP) "setuptools>=77" wheel ninja
	$(PIP) --no-build-isolation --editable ".[$(EXTRAS)]"
	@touch $@

demo: $(STAMP)
	$(BIN)/torchkcreg demo --out demo --overwrite

test: $(STAMP)
	$(PYTEST) -m "not slow"

# All tests, those against RTK among them; one that is skipped is a failure, unless it asks for data or a device from elsewhere.
test-full: $(STAMP)
	$(PIP) --no-build-isolation --editable ".[$(EXTRAS),parity]"
	$(PYTEST) --no-skips

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy torchkcreg
	$(BIN)/clang-format --dry-run --Werror $(SOURCES)

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(SOURCES)

clean:
	rm -rf build dist torchkcreg.egg-info torchkcreg/*.so .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find torchkcreg tests -name __pycache__ -type d -prune -exec rm -rf {} +
	rm -f $(STAMP)
