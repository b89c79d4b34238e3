# T4NMTD-dist: `make run` and `make test` are all that a newcomer needs; `make help` lists the rest.

VENV  := .venv
BIN   := $(VENV)/bin
STAMP := $(VENV)/.set-up

TASK ?= task7
ARGS ?=
TEST_CORES ?= 2

PYTEST   := $(BIN)/python -m pytest
PARALLEL := --numprocesses $(TEST_CORES) --dist loadfile

.DEFAULT_GOAL := help
.PHONY: help setup run test test-nightly test-fast lint type format bench clean

help: ## this list
	@echo "make VERB, where VERB is one of"
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1\t\2/p' $(MAKEFILE_LIST) | expand -t 12
	@echo "TASK=task8 chooses the task of run; ARGS='...' is passed on to run (t4nmtd train) and test (pytest)."

setup: $(STAMP) ## make .venv with everything needed, and install MONA if that can be done
	@:

$(STAMP): pyproject.toml constraints.txt deploy/setup.sh
	@sh deploy/setup.sh $(VENV)
	@touch $@

run: $(STAMP) ## train TASK (task7) with local processes and the dashboard until it is solved
	@$(BIN)/t4nmtd train --task $(TASK) $(ARGS)

# Tests of processes have deadlines: they run one after the other. pytest's exit code 5 means that no
# test was chosen, as when ARGS names a file that has tests of one kind only.
test: $(STAMP) ## run all tests but the nightly ones: on TEST_CORES cores, then those with deadlines one by one
	@$(PYTEST) -m "not process and not nightly" $(PARALLEL) $(ARGS); parallel=$$?; \
	$(PYTEST) -m "process and not nightly" $(ARGS); serial=$$?; \
	case "$$parallel $$serial" in "0 0" | "0 5" | "5 0") ;; *) exit 1 ;; esac

test-nightly: $(STAMP) ## run the long tests that make test leaves out
	@$(PYTEST) -m nightly $(ARGS)

test-fast: $(STAMP) ## run the tests that start no program, train nothing and take about a second at most, with fewer examples
	@$(PYTEST) -m "not (process or command or training or slow or nightly)" --hypothesis-profile fast $(PARALLEL) $(ARGS)

lint: $(STAMP) ## check style, formatting, and which package may import which
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/lint-imports --no-logo

type: $(STAMP) ## check types
	@$(BIN)/mypy

format: $(STAMP) ## format the code, and mend what ruff can mend
	@$(BIN)/ruff check --fix --exit-zero
	@$(BIN)/ruff format

bench: $(STAMP) ## run every benchmark, one after the other
	@set -e; for file in benchmarks/*.py; do echo "== $$file"; $(BIN)/python $$file; done

clean: ## delete what can be made again (runs/ and .venv stay)
	@rm -rf build dist ./*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	@find . -path ./$(VENV) -prune -o -path ./runs -prune -o -type d -name __pycache__ -exec rm -rf {} +
