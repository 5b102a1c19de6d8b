# Heliotrope: `make run` and `make test` do all that is needed; `make help` lists the rest.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Many tests wait for a clock or a page: two workers more than there are cores.
JOBS ?= $(shell expr $$(nproc) + 2)
# Of `make soak`: simulated runs of three minutes in drawn worlds.
RUNS ?= 2000
# Of `make mutants`.
SAMPLE ?= 500
# Of `make run`; see heliotrope run --help.
OPTIONS ?=
BOARD ?= rp2

.DEFAULT_GOAL := help
.PHONY: help setup run notebook quick test soak mutants lint docs lock audit bench house firmware clean

help:  ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | sort | expand -t 12

setup: $(STAMP)  ## make the environment in .venv

$(STAMP): pyproject.toml constraints.txt requirements.lock scripts/setup.sh src/heliotrope/__init__.py
	@PYTHON="$(PYTHON)" VENV="$(VENV)" bash scripts/setup.sh
	@touch $@

run: $(STAMP)  ## run a plant of 10,000 heliostats in simulation until Ctrl-C: OPTIONS="--speed 2"
	@$(BIN)/heliotrope run $(OPTIONS)

notebook: $(STAMP)  ## open the notebooks of examples/ in the browser
	@$(BIN)/jupyter lab --notebook-dir=examples

quick: $(STAMP)  ## run the tests nearest to what changed since main, and the linters (a minute)
	@HELIOTROPE_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m scripts.quick

test: $(STAMP)  ## run the tests in parallel
	@bash scripts/packages.sh & $(BIN)/python -m heliotrope.warm && $(BIN)/python -m heliotrope.twin.warm; warm=$$?; wait; exit $$warm
	@HELIOTROPE_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow" -q

soak: $(STAMP)  ## run the slow tests, then 2,000 simulated runs (an hour or two; goes on): RUNS=100
	@$(BIN)/python -m pytest -n $(JOBS) -q
	@mkdir -p out
	@$(BIN)/heliotrope simulate --seed 1 --hours 0.05 --world any --runs $(RUNS) --processes $(shell nproc) \
		--progress out/soak-any.jsonl

mutants: $(STAMP)  ## plant 500 small errors in the control code; what finds them (hours; goes on)
	@$(BIN)/python scripts/mutants.py --sample $(SAMPLE) --progress out/mutants.jsonl

lint: $(STAMP)  ## check style, types and layers
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

docs: $(STAMP)  ## build the documentation into site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# The oldest Python for which all pinned versions exist.
lock:  ## fetch the hashes of the packages that constraints.txt pins
	@$(BIN)/uv pip compile constraints.txt --generate-hashes --no-deps --universal --no-annotate --quiet \
		--python-version 3.11.5 --custom-compile-command "make lock" --output-file requirements.lock

audit: $(STAMP)  ## check pins, licences and known vulnerabilities; write the bill of materials into out/
	@$(BIN)/python scripts/audit.py
	@mkdir -p out && $(BIN)/python scripts/audit.py --sbom > out/heliotrope.cdx.json
	@$(BIN)/python scripts/audit.py --vulnerabilities

bench: $(STAMP)  ## run all benchmarks and keep their results in benchmarks/results/
	@$(BIN)/python -m benchmarks all

house: $(STAMP)  ## print packages, floors and what breaks the rules of the house
	@$(BIN)/python scripts/house.py

firmware: $(STAMP)  ## compile the firmware of a board: BOARD=rp2, esp32 or stm32
	@$(BIN)/python scripts/firmware.py $(BOARD)

clean:  ## remove what was built, but not the environment
	rm -rf build dist site out .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
