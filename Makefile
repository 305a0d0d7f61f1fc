# Everything that this makes lies in .venv/, build/ and out/. 'make' alone lists the targets.
PYTHON ?= python3
OUT ?= out/demo
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip
TORCH := $(shell sed -n 's/^torch==//p' constraints.txt)
FILES := $(sort $(shell find cgwm cgwm_cli datasets pipeline schemas -name '*.py' -o -name py.typed -o -name '*.cuh' -o -name '*.js' -o -name '*.css'))

PACKAGE = cgwm cgwm_cli pipeline datasets schemas
CHECKS = $(BIN)/ruff check && $(BIN)/ruff format --check && $(BIN)/pyright

.PHONY: help install demo test lint same graph docs dist results evidence clean force

help:
	@echo 'make demo      run the whole pipeline on a scene that it makes itself; the report: $(OUT)/report.html'
	@echo 'make test      lint, type check of the package and tests, as the continuous integration runs them'
	@echo 'make install   only install cgwm into $(VENV)/ (the two above do it by themselves)'
	@echo 'make lint      ruff and pyright alone, of tests and benchmarks too'
	@echo 'make same      compare what this tree computes with the outputs of the last commit (tools/same.py)'
	@echo 'make graph     print the import graph of the rooms, and draw it: docs/import-graph.svg'
	@echo 'make docs      build the documentation as a site that is read offline: build/docs/index.html'
	@echo 'make dist      the source archive, and the wheel that is built from it: dist/'
	@echo 'make evidence  the measurements that take longer than tests may; resumable, results in out/evidence/'
	@echo 'make results   write docs/results*.md and docs/engine-table.md from the stored figures'
	@echo 'make clean     remove what make made: $(VENV)/, build/, out/'

install: $(VENV)/linked

# out/ is make's own product, so a second 'make demo' replaces the first; 'cgwm demo' itself would refuse.
demo: install
	$(BIN)/cgwm demo $(OUT) --overwrite

# One thread a worker: the tensors of tests are too small to share out, and the workers share the cores. Bytecode is kept
# whatever the environment says: without it each process of the tests compiles what it imports, a worker for five seconds.
# The checks of the text run meanwhile, one after the other; what they print is shown after the tests. Types are checked
# in the package: what the tests call is executed here, and 'make lint' takes half a minute more to check their types.
test: install
	@mkdir -p build && rm -f build/lint.log
	@{ $(CHECKS) $(PACKAGE); } > build/lint.log 2>&1 & checks=$$!; \
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder; tests=$$?; \
	wait $$checks; checks=$$?; cat build/lint.log; \
	[ $$tests = 0 ] || echo 'make test: pytest failed' >&2; [ $$checks = 0 ] || echo 'make test: ruff or pyright failed' >&2; \
	[ $$tests = 0 ] && [ $$checks = 0 ]

lint: install
	$(CHECKS)

same: install
	$(BIN)/python tools/same.py

graph:
	$(PYTHON) tools/import_graph.py

# Strict: a dead link, a missing reference or a page outside of the navigation fails.
docs: $(VENV)/docs
	@mkdir -p build/docs-source  # it has to be there before mkdocs resolves the search path of the reference
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo 'Open build/docs/index.html'

# The wheel is built from the archive, so that an archive which lacks a file fails here.
dist: install
	@rm -rf dist && mkdir dist
	@$(BIN)/python -c "from setuptools import build_meta; build_meta.build_sdist('dist')" > dist/build.log
	@$(PIP) wheel --quiet --no-deps --no-build-isolation --no-index --wheel-dir dist dist/*.tar.gz
	@rm dist/build.log && ls -l dist

evidence: install
	$(BIN)/pytest -m evidence
	cd tests && for what in '--cases 3000 --seed 1' '--table refuse' '--table accept'; do echo "== fuzz $$what"; OMP_NUM_THREADS=1 PYTHONSAFEPATH=1 PYTHONPATH=. ../$(BIN)/python -m fuzz $$what --failures ../out/evidence/fuzz || echo "fuzz: a bar was missed"; done
	cd benchmarks && for one in calibrate tosses fall coverage known_mesh next_throw real_data; do echo "== $$one"; ../$(BIN)/python $$one.py || echo "$$one: a bar was missed"; done

results: install
	$(BIN)/python benchmarks/render_results.py
	$(BIN)/python benchmarks/engine_page.py

clean:
	rm -rf $(VENV) build out dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/made:
	@command -v '$(PYTHON)' >/dev/null || { \
	  echo "'$(PYTHON)' was not found. Next: install Python 3.11 or newer, or name it: make PYTHON=/path/to/python3" >&2; exit 2; }
	@'$(PYTHON)' -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "cgwm needs Python 3.11 or newer; '$(PYTHON)' is $$('$(PYTHON)' --version 2>&1)." >&2; \
	  echo "Next: name a newer one, for example: make PYTHON=python3.12" >&2; exit 2; }
	@'$(PYTHON)' -m venv $(VENV)
	@$(PIP) install --quiet --upgrade pip
	@touch $@

# Without an NVIDIA GPU the CPU build of torch: from where pip looks anyway if it is there, else from PyTorch's own index.
$(VENV)/dependencies: pyproject.toml constraints.txt | $(VENV)/made
	@echo 'Installing the dependencies into $(VENV)/: some minutes the first time.'
	@if [ "$$(uname -s)" = Linux ] && ! command -v nvidia-smi >/dev/null; then \
	  $(PIP) install --quiet --no-deps 'torch==$(TORCH)+cpu' 2>/dev/null || \
	  $(PIP) install --quiet --no-deps 'torch==$(TORCH)+cpu' --index-url https://download.pytorch.org/whl/cpu; \
	else $(PIP) install --quiet --no-deps 'torch==$(TORCH)'; fi
	@$(BIN)/python -c "import tomllib; project = tomllib.load(open('pyproject.toml', 'rb')); \
	  extras = project['project']['optional-dependencies']; \
	  lists = project['build-system']['requires'], project['project']['dependencies'], extras['dev']; \
	  print(*sum(lists, []), sep='\n')" > $(VENV)/requirements.txt
	@$(PIP) install --quiet -c constraints.txt -r $(VENV)/requirements.txt
	@touch $@

# Only 'make docs' needs these, and it needs no other dependency: the reference is drawn without importing anything.
$(VENV)/docs: pyproject.toml constraints.txt | $(VENV)/made
	@$(BIN)/python -c "import tomllib; \
	  print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['optional-dependencies']['docs'], sep='\n')" \
	  > $(VENV)/requirements-docs.txt
	@$(PIP) install --quiet -c constraints.txt -r $(VENV)/requirements-docs.txt
	@touch $@

# Strict editable mode links each file, so that type checkers follow it; new files need to be linked anew. pip compiles
# what it installs, but not what it links.
$(VENV)/linked: $(VENV)/dependencies $(VENV)/files
	@$(PIP) install -qq --no-deps --no-build-isolation --config-settings editable_mode=strict -e .
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -m compileall -q build/__editable__*
	@touch $@

$(VENV)/files: force | $(VENV)/made
	@echo '$(FILES)' | cmp -s - $@ || echo '$(FILES)' > $@
