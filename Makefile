# make setup | demo | test | test-full | docs | lint | format | clean        (make help says more)
#
# VENV     folder of the environment                        make test VENV=/tmp/kcreg
# PYTHON   interpreter, Python 3.10 or later                make test PYTHON=python3.12
# TORCH    version of torch, 2.10 or later                  make test TORCH=torch==2.13.0
# TORCH_PIP_FLAGS   pip options for torch, e.g. --index-url of the build without CUDA
# EXTRAS   extras to install                                  make test EXTRAS=dev
# JOBS     number of parallel test processes                make test JOBS=8
# WORK, DATA   folder of intermediate results, folder of real frames   make validation DATA=knee

VENV ?= .venv
PYTHON ?= python3
TORCH ?= torch>=2.10
TORCH_PIP_FLAGS ?=
EXTRAS ?= dev,docs,notebooks,simulate
JOBS ?= 2
WORK ?= validation

BIN := $(VENV)/bin
STAMP := $(VENV)/.torchkcreg-is-installed
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet
SOURCES := $(wildcard torchkcreg/csrc/*.cpp torchkcreg/csrc/*.h torchkcreg/csrc/*/*.cpp torchkcreg/csrc/*/*.h)
PYTEST := OMP_NUM_THREADS=1 MPLBACKEND=Agg $(BIN)/python -m pytest -n $(JOBS) --doctest-modules torchkcreg tests

.PHONY: help setup demo test test-full validation docs lint results format clean
.DEFAULT_GOAL := help

help:
	@echo "make setup      make an environment in $(VENV) with the library and its development tools"
	@echo "make demo       simulate a loaded plate, register it, evaluate and draw the result, into demo/"
	@echo "make test       run the quick tests and the docstring examples"
	@echo "make test-full  run all tests, including slow ones and those against RTK"
	@echo "make validation  measure the accuracy on simulated visits, and on real frames with DATA=folder: an hour"
	@echo "make docs       build the documentation site in site/; a broken link is an error"
	@echo "make lint       check with ruff, mypy and clang-format; changes nothing"
	@echo "make results    write the figures of benchmarks/results into README and documentation"
	@echo "make format     format with ruff and clang-format"
	@echo "make clean      remove build and test files (keeps demo/ and the environment)"

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

# All tests, including those against RTK. A skipped test is a failure unless it needs external data or a device.
test-full: $(STAMP)
	$(PIP) --no-build-isolation --editable ".[$(EXTRAS),parity]"
	$(PYTEST) --no-skips

# Simulated cases and visits, and with DATA=folder the real frames of a knee, see docs/validation.md.
validation: $(STAMP)
	$(BIN)/python benchmarks/demo.py
	$(BIN)/python benchmarks/visits.py --work $(WORK)/visits --write
	$(if $(DATA),$(BIN)/python benchmarks/knee_biplane.py $(DATA) --work $(WORK)/knee --write)

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy torchkcreg
	$(BIN)/clang-format --dry-run --Werror $(SOURCES)
	$(BIN)/python scripts/results.py --check

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(SOURCES)

results: $(STAMP)
	$(BIN)/python scripts/results.py

clean:
	rm -rf build dist torchkcreg.egg-info torchkcreg/*.so .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find torchkcreg tests -name __pycache__ -type d -prune -exec rm -rf {} +
	rm -f $(STAMP)
