# make demo   edit the bundled asset, write pictures and receipt to demo/
# make studio paint in the browser
# make native compile the kernels after an edit of native/
# make test   run the tests            make check   format, lint, types, docs      make fuzz   hostile inputs
# make quick  while you type: < 1 min  make docs    the site
PY := .venv/bin/python
PIP := $(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: demo studio native test test-web test-python quick fuzz check check-types check-systems check-web check-docs docs format clean
.DEFAULT_GOAL := demo

demo: .venv/installed
	.venv/bin/splatpainter demo --out demo

studio: .venv/installed-studio
	.venv/bin/splatpainter studio

# `make demo` and every installation do this too; pip's ziglang is the compiler.
native: .venv/installed
	$(PIP) ziglang
	$(PY) native/build.py

# The page's tests beside Python's. One more worker than cores (conftest.py): tests that wait for a browser, a cluster or
# a program leave theirs idle. Workers take tests from each other when they have none left.
WORKERS ?= auto
test: .venv/installed-dev
	$(MAKE) --no-print-directory --jobs 2 test-web test-python
test-web:
	scripts/web test
test-python:
	OMP_NUM_THREADS=1 $(PY) -m pytest -n $(WORKERS) --dist worksteal

# Hostile inputs for all readers, projects and the studio: make fuzz SECONDS=3600 JOBS=2 TARGETS=ply,spz SEED=7
SECONDS ?= 600
JOBS ?= 2
TARGETS ?= all
SEED ?= 0
fuzz: .venv/installed-dev
	OMP_NUM_THREADS=1 $(PY) -m tests.fuzz --seconds $(SECONDS) --jobs $(JOBS) --targets $(TARGETS) --seed $(SEED)

check: .venv/installed-dev
	.venv/bin/ruff format --check .
	.venv/bin/ruff check .
	.venv/bin/typos
	$(PY) scripts/words.py
	$(PY) scripts/wrap_docs.py --check
	$(MAKE) --no-print-directory --jobs 2 check-types check-systems check-web check-docs

# Two at a time; types take the longest, and so both cores.
check-types:
	.venv/bin/pyright --threads 2
check-systems:
	$(PY) scripts/check_platforms.py
check-web:
	scripts/web check
check-docs:
	scripts/docs

# What can be said within a minute: lint, and the tests of the core that compile nothing new.
quick: .venv/installed-dev
	.venv/bin/ruff format --check .
	.venv/bin/ruff check .
	OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist loadfile -m 'not slow' $(QUICK)
QUICK := tests/test_imports.py tests/test_names.py tests/test_docs.py tests/test_splats.py tests/test_cameras.py tests/test_transforms.py tests/test_color.py tests/lift tests/nn tests/voxels tests/session/test_layers.py

docs: .venv/installed-dev
	scripts/docs

format: .venv/installed-dev
	.venv/bin/ruff format .
	.venv/bin/ruff check --fix .

.venv/installed: pyproject.toml constraints.txt
	test -x $(PY) || python3 -m venv .venv
	$(PIP) -e .
	touch $@

.venv/installed-studio: .venv/installed
	$(PIP) -e '.[studio]'
	touch $@

# CPU torch first where there is no NVIDIA GPU, so that no CUDA packages are pulled.
.venv/installed-dev: .venv/installed benchmarks/pyproject.toml networks/pyproject.toml train/pyproject.toml scripts/install-torch
	scripts/install-torch $(PY)
	$(PIP) -e '.[dev]' -e train -e benchmarks -e networks
	$(PIP) --no-deps gsplat  # its plain-torch formulas are an oracle of the tests; its kernels need CUDA
	$(PIP) --no-deps gsply numba llvmlite gaussforge usd-core  # readers and writers of SPZ and USD, oracles of the tests; gsply wants numba
	touch $@

clean:
	rm -rf .venv demo
