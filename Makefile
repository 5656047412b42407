# `make train` and `make test` need nothing but Python >= 3.11: they make .venv, install into it, and run.
#
#   make train [OUT=runs/heaven_hell] [ARGS="--seeds 5"]   a new run with ARGS; or on with the one in OUT, as it was begun
#   make test  [ARGS="-k losses"]                          the tests, without the slow ones
#   make test-slow   make lint   make bench   make clean
#   make viewer      the scripts inside the pages of `mijax.evaluate --planner --html`; needs npm

PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && { echo $$p; break; }; done)
OUT ?= runs/heaven_hell
ARGS ?=
# One process per core; the tests of a file stay together, since they share compiled programs.
PARALLEL := --numprocesses auto --dist loadfile --no-loadscope-reorder

VENV := .venv
RUN := $(VENV)/bin/python
INSTALLED := $(VENV)/.installed

.PHONY: train test test-slow lint bench viewer clean
.DELETE_ON_ERROR:

# config.json is the last file that a new run folder gets, so its presence means that there is a run to go on with.
train: $(INSTALLED)
	@if [ -f "$(OUT)/summary.json" ]; then \
		echo "$(OUT) is finished (see $(OUT)/summary.json and curve.png). Another run: make train OUT=runs/other"; \
	elif [ -f "$(OUT)/config.json" ]; then \
		$(RUN) -m mijax.train --resume "$(OUT)"; \
	else \
		$(RUN) -m mijax.train --domain heaven_hell --out "$(OUT)" $(ARGS); \
	fi

test: $(INSTALLED)
	$(RUN) -m pytest -m "not slow" $(PARALLEL) $(ARGS)

test-slow: $(INSTALLED)
	$(RUN) -m pytest -m slow $(PARALLEL) $(ARGS)

lint: $(INSTALLED)
	$(RUN) -m ruff check .
	$(RUN) -m pyright --pythonpath $(RUN)

bench: $(INSTALLED)
	$(RUN) -m launch.bench $(ARGS)

# The versions that brax 0.14.2's viewer was written for.
viewer: $(INSTALLED)
	npm install --silent --no-save --no-audit --no-fund --prefix .cache/viewer three@0.150.1 lil-gui@0.18.0
	$(RUN) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[robot]'

clean:
	rm -rf $(VENV) .cache .pytest_cache .ruff_cache .hypothesis build dist

$(INSTALLED): pyproject.toml constraints.txt
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "mijax needs Python >= 3.11; found: $$("$(or $(PYTHON),python3)" --version 2>/dev/null || echo none)." \
			"Name another one: make PYTHON=/path/to/python3.12 ..." >&2; exit 1; }
	"$(PYTHON)" -m venv --clear $(VENV)
	$(RUN) -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@
