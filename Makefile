# Every target does its own set-up: a fresh machine needs Python 3.11 with venv, and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TEST_WORKERS ?= 2
# What street-models trains on: cpu, or cuda with many cores beside it.
DEVICE ?= cpu

.PHONY: setup demo test lint check street-models clean

setup: $(READY)

$(READY): pyproject.toml constraints.txt Makefile
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[train,dev]'
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-deps rtmlib
	touch $@

demo: $(READY)
	$(BIN)/animatic demo

test: $(READY)
	$(BIN)/python -m pytest -n $(TEST_WORKERS) --dist loadfile

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

check: test lint

street-models: $(READY)
	$(BIN)/python -m training.street_models --device $(DEVICE)

clean:
	rm -rf demo .pytest_cache .ruff_cache
