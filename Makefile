# make demo: people seen by three LiDARs, true and predicted. make test: the tests. Both set up .venv first.
PYTHON ?= python3
PIP = .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test lint clean

demo: .venv/all
	.venv/bin/lidarpose demo

test: .venv/test
	.venv/bin/python -m pytest

lint: .venv/test
	$(PIP) ruff
	.venv/bin/ruff check . && .venv/bin/ruff format --check .

.venv/all: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) --editable '.[all]'
	touch $@

.venv/test: .venv/all
	$(PIP) --editable '.[all,test]'
	touch $@

clean:
	rm -rf .venv build dist lidarpose-demo
