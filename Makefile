# make install | demo | test | test-long | check | docs | bench | bench-all | faults | fuzz | soak | compose | release | clean
#
# TORCH_INDEX: for the tests and the laboratory, on a machine with the whole internet, the address of PyTorch's CPU index:
# its "Get Started" selector prints it after --index-url. Unset, torch comes from the ordinary index (on Linux the CUDA
# build).
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || echo python3)
TORCH_INDEX ?=
MINUTES ?= 10
IMAGES ?= auto
AICVDS_BUILD_NETWORK ?= default
BIN := .venv/bin

# Even where the shell forbids it: without compiled modules each of the tests' processes takes 5 s longer to start.
export PYTHONDONTWRITEBYTECODE :=

# mypy 2.4 may infer different types in different runs, by the order of its sets: PYTHONHASHSEED makes its result stable.
.PHONY: help install demo test test-long check docs bench bench-all faults fuzz soak compose release clean
.DEFAULT_GOAL := help

help:
	@echo "make install   a virtual environment in .venv with everything, and the embedded model"
	@echo "make demo      install what it needs, start the edge with its LLM, fly the paper's mission, write runs/demo/report.html"
	@echo "make test      install, run the tests: 4 to 11 minutes on 2 cores"
	@echo "make test-long install, run the tests that train, run experiments and benchmarks, and fly whole missions"
	@echo "make check     install, ruff, mypy --strict, import-linter"
	@echo "make docs      install, build the documentation into site/, to be read without a network"
	@echo "make bench     measure the edge and its LLM, side by side with others: docs/results/benchmarks.md; 7 minutes"
	@echo "make bench-all the same, and the other benchmarks: runs/*.json"
	@echo "make faults    fail, kill and starve real processes, and write docs/results/faults.md: 10 minutes"
	@echo "make fuzz      10,000 generated requests, maps and plans: none breaks the edge, or flies outside its fences"
	@echo "make soak      fly 200 missions for MINUTES=10: memory, tasks and connections must not grow"
	@echo "make compose   build the containers and fly a mission in them (needs a Docker engine)"
	@echo "make release   build and try wheel, sdist and SBOM in dist/, and the images; IMAGES=required: fail without images"

install: .venv/installed

# install.py makes a new .venv where this one is a copy of another checkout's, or its Python is gone.
USABLE := $(shell .venv/bin/python -c '' >/dev/null 2>&1 && grep -Fqs '$(CURDIR)/.venv/bin/' .venv/bin/pip && echo yes)
REMADE := $(if $(USABLE),,remade)
.PHONY: remade

.venv/installed: pyproject.toml constraints.txt install.py $(REMADE)
	$(PYTHON) install.py all $(TORCH_INDEX:%=--torch-index %)
	@touch $@ .venv/demo

# What serves, simulates and draws.
.venv/demo: pyproject.toml constraints.txt install.py $(REMADE)
	$(PYTHON) install.py demo
	@touch $@

demo: .venv/demo
	$(BIN)/aicvds demo --out runs/demo

# In advance, because a test that waits for the compiler may run into a limit of time; a second once it is done.
COMPILE = $(BIN)/python -c 'from service.edge.compilation import compile_all; compile_all()'
# The variable is that of `aicvds serve`, here before llama.cpp is loaded: its threads share the cores with other
# tests, and would spin while one waits for the other.
# Three workers on two cores: many tests wait for processes, browsers and pauses. The long tests compute, and those that
# start Ray's clusters ran out of patience beside two others.
WORKERS ?= $(shell echo $$(( ($$(getconf _NPROCESSORS_ONLN) * 3 + 1) / 2 )))
PYTEST = GOMP_SPINCOUNT=1000 $(BIN)/pytest --numprocesses $(WORKERS) --maxprocesses 4 --dist loadfile --no-loadscope-reorder

test: install
	$(COMPILE)
	$(PYTEST)

test-long: WORKERS = auto
test-long: install
	$(COMPILE)
	$(PYTEST) -m long

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	PYTHONHASHSEED=0 $(BIN)/mypy
	PYTHONHASHSEED=0 $(BIN)/mypy benchmarks release.py
	$(BIN)/lint-imports

docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# On two idle cores. The other modules of benchmarks/ measure more of each, and have --help.
bench: install
	$(BIN)/python -m benchmarks.questions --page docs/results/benchmarks.md

# The page needs Chromium.
bench-all: bench
	$(BIN)/python -m benchmarks.processor_stages
	$(BIN)/python -m benchmarks.tokens --seeds 3
	$(BIN)/python -m benchmarks.world
	$(BIN)/python -m benchmarks.planning --rounds 2
	$(BIN)/python -m benchmarks.capacity
	-$(BIN)/python -m benchmarks.page --seconds 10

faults: install
	$(BIN)/pytest -m faults --capture=tee-sys tests/faults tests/e2e/test_fly.py

fuzz: install
	$(BIN)/pytest -m fuzz --capture=tee-sys tests/faults tests/unit

soak: install
	$(BIN)/python -m benchmarks.soak --minutes $(MINUTES)

compose:
	tests/e2e/compose.sh

release: install
	$(BIN)/python release.py --images $(IMAGES) --build-network $(AICVDS_BUILD_NETWORK)

clean:
	rm -rf .venv build dist *.egg-info
