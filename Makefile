# make demo    set up, then simulate events, train on them, evaluate and render: outputs/demo/
# make release-run   the demo, its run and its recording packed as the file of a release: outputs/demo.zip
# make test    set up, then run every check and every test, of long sweeps a part;   make test-all   those in full
# make docs    set up, then write the pages as a site: build/docs/index.html (Python 3.11 or later)
# make results train and score every table of the pages, which takes many hours, and put them there;
#              SLIDER_DEPTH= its recording, WEIGHTS= those of FireNet or E2VID
# make lint    the checks alone;   make format   repair what can be repaired;   make clean   undo the set-up
# PYTHON=...   the interpreter to set up with (3.10 to 3.12)

USABLE = import ensurepip, sys, venv; sys.exit(not (3, 10) <= sys.version_info < (3, 13))
PYTHON ?= $(shell for python in python3.12 python3.11 python3.10 python3; do \
	"$$python" -c '$(USABLE)' 2>/dev/null && echo "$$python" && break; done)
# The name of the stamp changes with what it depends on, so that an unchanged set-up costs nothing, a fresh checkout included.
STAMP := .venv/set-up-$(shell cat pyproject.toml constraints.txt | cksum | cut -d' ' -f1)

.PHONY: demo release-run test test-all results docs lint format clean

demo: $(STAMP)
	.venv/bin/enerf demo --output-dir outputs/demo

release-run: demo
	.venv/bin/enerf export run "$$(ls -d outputs/demo/runs/recording/enerf/*/ | tail -n 1)" --output outputs/demo.zip

test: lint
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 .venv/bin/pytest --slow -n 2 --dist worksteal

test-all: lint
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 .venv/bin/pytest --exhaustive -n 2 --dist worksteal

results: $(STAMP)
	.venv/bin/python benchmarks/results.py --pages $(if $(SLIDER_DEPTH),--slider-depth "$(SLIDER_DEPTH)") \
	    $(if $(WEIGHTS),--reconstruction-weights "$(WEIGHTS)")

lint: $(STAMP)
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	rm -rf build && .venv/bin/python -m pip install --quiet --no-deps --no-build-isolation --no-compile \
	    --target build/typecheck . && cp -r tests benchmarks pyproject.toml build/typecheck
	cd build/typecheck && PYRIGHT_PYTHON_IGNORE_WARNINGS=1 ../../.venv/bin/pyright --pythonpath ../../.venv/bin/python

docs: $(STAMP)
	.venv/bin/sphinx-build -q -W --keep-going -E docs build/docs

format: $(STAMP)
	.venv/bin/ruff check --fix
	.venv/bin/ruff format

clean:
	rm -rf .venv build *.egg-info

# Nerfstudio brings opencv-python-headless, which owns the same folder cv2/ as opencv-contrib-python-headless: the latter
# comes last.
$(STAMP):
	@.venv/bin/python -m pip --version >/dev/null 2>&1 || test -n "$(PYTHON)" || { echo "No Python 3.10, 3.11 or 3.12 \
	with venv and ensurepip was found: install one, or name one with PYTHON=/path/to/python3." >&2; exit 1; }
	.venv/bin/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear .venv
	.venv/bin/python -m pip install -c constraints.txt -e '.[dev]'
	.venv/bin/python -m pip install -c constraints.txt --no-deps --force-reinstall opencv-contrib-python-headless
	rm -f .venv/set-up-*
	touch $@
