# make demo: synthesizes people scanned by three LiDARs and draws true and predicted poses. make test: the default tests, in
# two processes. make test-long: the longer tests of CI. All targets set up .venv first.
PYTHON ?= python3
PIP = .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test test-long test-slow fuzz check lint docs clean

demo: .venv/synth
	.venv/bin/lidarpose demo

test: .venv/test
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 --dist loadfile

# tests that take more than a second each, mostly training runs that are interrupted, resumed and evaluated
test-long: .venv/test
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 --dist loadfile -m long

# tests that take more than ten seconds each: figures of the README, exports, the wheel, types of snippets in the docs
test-slow: .venv/test
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 --dist loadfile -m slow

# random damaged files for all readers, different ones in each run, about ten minutes
fuzz: .venv/test
	OMP_NUM_THREADS=1 FUZZ_EXAMPLES=7500 .venv/bin/python -m pytest tests/test_fuzz.py

# style and types; "lint" is an alias
check: .venv/test
	$(PIP) ruff mypy
	.venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/mypy

lint: check

# the site, in site/; open site/index.html
docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict

.venv/bin/python:
	$(PYTHON) -m venv .venv

# prediction and the demo do not need torch, which is a large download
.venv/synth: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) --editable '.[synth]'
	touch $@

.venv/test: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) --editable '.[all,test]'
	touch $@

.venv/docs: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) --editable '.[docs]'
	touch $@

clean:
	rm -rf .venv build dist site lidarpose-demo
