# make demo: people seen by three LiDARs, true and predicted. make test: the tests, two files at a time; make test-long: the
# rest of what a change must pass. All set up .venv first.
PYTHON ?= python3
PIP = .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

.PHONY: demo test test-long test-slow fuzz check lint docs clean

demo: .venv/synth
	.venv/bin/lidarpose demo

test: .venv/test
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 --dist loadfile

# the tests that take more than a second each, mostly runs that are killed, taken up and scored
test-long: .venv/test
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 --dist loadfile -m long

# the tests that take more than ten seconds each: README's figures, exports, the wheel, the types of the pages' snippets
test-slow: .venv/test
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 --dist loadfile -m slow

# damaged and hostile files for the readers, about ten minutes, other ones each time
fuzz: .venv/test
	OMP_NUM_THREADS=1 FUZZ_EXAMPLES=7500 .venv/bin/python -m pytest tests/test_fuzz.py

# style, then types; "lint" is its older name
check: .venv/test
	$(PIP) ruff mypy
	.venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/mypy

lint: check

# the site, in site/; open site/index.html
docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict

.venv/bin/python:
	$(PYTHON) -m venv .venv

# predicting and the demo need no torch: the install is far smaller without
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
