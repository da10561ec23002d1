# Everything a newcomer needs: `make demo`, `make test`. Each target sets itself up first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# One thread a process: the work is parallel over processes, and libraries that spin up
# threads of their own only fight with it.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
# Tests start hundreds of processes: whatever the surroundings say, each module is compiled once.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help install demo test test-slow test-tools test-all serve check security torture fuzz format bench docs notebooks \
  wheel-check lowest-check gallery lock \
  container-check clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

$(STAMP): requirements/lock.txt pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing locked packages into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements/lock.txt
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

install: $(STAMP) ## make the virtual environment with locked versions

demo: install ## photos in, lens calibrated, corrected photo out: see demo-output/report.md
	@$(BIN)/lensmodel demo --output demo-output

# a file at a time: its services and photos are made once, not once for each of the two processes
test: install ## the tests that need nothing but this repository: minutes
	@$(BIN)/python -m pytest -q -n 2 --dist loadfile -m "not slow and not tools"

test-slow: install ## the slow ones of those: ten minutes
	@$(BIN)/python -m pytest -q -n 2 --dist loadfile -m "slow and not tools"

test-tools: install ## those with servers, a browser, programs and data beyond the repository
	@$(BIN)/python -m pytest -q -n 2 --dist loadfile -m tools

test-all: test test-slow test-tools ## all three

serve: install ## run the service until interrupted
	@$(BIN)/lensmodel serve

check: install ## format, lint, types, import layers
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy lensmodel app lab
	@$(BIN)/lint-imports

security: install ## known holes in what we use (asks the network), and suspicious code of ours
	@$(BIN)/pip-audit --require-hashes --disable-pip --requirement requirements/run.txt
	@$(BIN)/bandit --quiet --recursive --severity-level medium --confidence-level medium app lensmodel

SEEDS ?= 20
torture: install ## random deaths and outages, SEEDS times on SQLite and on PostgreSQL with S3
	@$(BIN)/python tests/app/endurance/torture.py --seeds $(SEEDS)
	@$(BIN)/python tests/app/endurance/torture.py --seeds $(SEEDS) --servers

MINUTES ?= 10
fuzz: install ## made-up requests and damaged files, MINUTES each
	@$(BIN)/python tests/app/endurance/fuzz_api.py --minutes $(MINUTES)
	@$(BIN)/python tests/app/endurance/fuzz_parsers.py --minutes $(MINUTES)

format: install ## let the formatter and the linter mend what they can
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

bench: install ## quality and speed benchmarks, tables on standard output
	@$(BIN)/lensmodel bench blind --cases 12
	@$(BIN)/lensmodel bench model --seeds 1000:1002
	@$(BIN)/lensmodel bench correct --methods fast,standard

docs: install ## the reference as a static site, site/index.html
	@$(BIN)/mkdocs build --strict --quiet

notebooks: install ## run the notebooks of docs/notebooks anew, minutes
	@$(BIN)/python tools/run_notebooks.py docs/notebooks/*.ipynb

wheel-check: ## build the wheel and use it in clean environments (asks the network)
	@tools/wheel_check.sh $(PYTHON)

lowest-check: ## a part of the tests with the lowest versions that pyproject.toml allows (asks the network)
	@tools/lowest_check.sh $(PYTHON)

gallery: install ## pictures to look at, gallery-output/index.html (real ones with LENSMODEL_TEST_DATA)
	@$(BIN)/lensmodel bench gallery --output gallery-output

LOCK := uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-header
lock: ## renew the files of requirements/ from pyproject.toml (needs uv)
	$(LOCK) --extra service --extra fits --extra cluster --group dev --output-file requirements/lock.txt pyproject.toml
	$(LOCK) --extra service --output-file requirements/run.txt pyproject.toml
	echo hatchling | $(LOCK) --output-file requirements/build.txt -

container-check: ## build the image without an engine, start it and use it (root; Debian's buildah and debootstrap)
	tools/container_check.sh

clean: ## remove what the targets made
	rm -rf $(VENV) demo-output bench-output gallery-output .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
