# `make demo` or `make test` on a fresh machine does all the set-up; a later run starts at once.
# A distribution's own Python is preferred if it is new enough: unlike most others, it is built with profile-guided
# optimization, which the loop at 1 kHz feels.
ifndef PYTHON
PYTHON := $(shell /usr/bin/python3 -c 'import sys, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& echo /usr/bin/python3 || echo python3)
endif
VENV   ?= .venv

RUN   := $(VENV)/bin/python
STAMP := $(VENV)/.vtbdrake-installed

# The stamp names the checkout and the PYTHON it was made for. Set up again when the checkout has moved, the interpreter is
# gone, or another PYTHON is asked for explicitly.
ASKED := $(if $(filter file,$(origin PYTHON)),,$(PYTHON))
STALE := $(shell tools/setup.sh --check "$(VENV)" "$(ASKED)" || echo stale)

# Every child process of the tests imports the package, and starts sooner with byte code.
unexport PYTHONDONTWRITEBYTECODE

# What is compiled, and what lcm-gen makes modules of.
SOURCES := $(shell find vtbdrake diagrams -name '*.pyx' -o -name '*.pxd' -o -name '*.lcm')

.DEFAULT_GOAL := help
.PHONY: help python setup demo demo-control test test-all verify check docs dist answers bench clean stale

help:
	@echo "make demo                          the space climber, from the question to the answer"
	@echo "make demo-control                  an arm, from the simulation to the machine, at 1 kHz; the machine killed, and back"
	@echo "make test [ARGS='-k name']         the quick tests: all but those marked slow"
	@echo "make test-all [ARGS='-k name']     all tests"
	@echo "make verify                        the cases with known answers among them, with their errors in a table"
	@echo "make check                         ruff, mypy, scripts of pages, the public interface against that of the newest release, sizes and circles"
	@echo "make docs                          the documentation site, in build/docs/"
	@echo "make answers [ONLY=O4] [FULL=1]    every application's question and answer; writes answers.json"
	@echo "make bench [ONLY=name] [PAGE=1]    every claim of speed; writes benchmarks/results.json, and docs/benchmarks.md"
	@echo "make dist [PYTHONS=python3.12]     source distribution and a wheel per Python, in dist/, tried in empty environments"
	@echo "make setup                         only the environment that the others need"
	@echo "make clean                         remove environments, caches and results"
	@echo
	@echo "PYTHON=$(PYTHON) (3.11 or newer) and VENV=$(VENV) can be set on the command line."

python:
	@echo $(PYTHON)

setup: $(STAMP)

demo: $(STAMP)
	$(RUN) -m vtbdrake_diagrams.space_climber.demo

demo-control: $(STAMP)
	$(RUN) -m vtbdrake_diagrams.manipulator.demo

# In the order of the folders: by default, files of few tests come last, and the longest of them keep one worker busy in the
# end. Two workers more than processors: some tests wait for other processes, for sockets and for the clock. A worker that
# crashes ends the run at once: another one in its place would leave tests out, and wait for ever at the end.
PYTEST = $(RUN) -m pytest --numprocesses $$(($$(nproc) + 2)) --maxprocesses 4 --max-worker-restart 0 \
	--dist loadfile --no-loadscope-reorder --durations 50 --durations-min 1

test: $(STAMP)
	$(PYTEST) -m "not slow" $(ARGS)

test-all: $(STAMP)
	$(PYTEST) $(ARGS)

verify: $(STAMP)
	$(RUN) -m tests.verification $(ARGS)

check: $(STAMP)
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy
	$(RUN) tools/public_api.py
	tools/javascript/check.sh
	$(RUN) tools/house.py

# Warnings are errors: a link that leads nowhere, a page that is not in docs/index.md.
docs: $(STAMP)
	$(RUN) -m sphinx --quiet --fail-on-warning --keep-going -c docs . build/docs
	@echo "build/docs/index.html"

dist: $(STAMP)
	tools/dist.sh $(VENV) $(PYTHONS)

answers: $(STAMP)
	$(RUN) -m vtbdrake_diagrams.answers $(ONLY) $(if $(filter-out 0,$(FULL)),--full)

bench: $(STAMP)
	$(RUN) -m benchmarks $(ONLY) $(if $(filter-out 0,$(PAGE)),--page docs/benchmarks.md)

$(STAMP): pyproject.toml setup.py $(wildcard constraints/*.txt) tools/setup.sh $(SOURCES) $(if $(STALE),stale)
	@tools/setup.sh "$(VENV)" $(if $(STALE),"$(PYTHON)")

stale:

clean:
	rm -rf .venv .venv-* build dist docs/_api *.egg-info out answers.json benchmarks/results.json
	rm -rf tools/javascript/node_modules .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find vtbdrake diagrams \( -name '*.so' -o -name 'lcmt_vtb_*.py' \) -delete
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
