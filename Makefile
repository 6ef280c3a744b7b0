# Everything runs inside .venv, which each target makes when it is missing or older than pyproject.toml. Modules are
# compiled when they are imported: compiling all that comes along takes two fifths of the installation. An old pip takes
# twice the time of a new one, but does where none is to be had. What has been compiled is kept in .venv, also where the
# shell says otherwise: else every process would compile it anew.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
unexport PYTHONDONTWRITEBYTECODE

.PHONY: commands install demo test acceptance quick style lint check clean pardiso schemas docs lock dist dist-test minimum report-check export-check figures

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	-$(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile --upgrade pip
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile --editable ".[dev]"
	touch $@

# Intel's PARDISO, which benchmarks/speed.py --parts solver compares our solver with; nothing else uses it.
pardiso: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[benchmark]"

demo: install
	$(BIN)/palpate demo --output demo-output

style: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

lint: style
	$(BIN)/mypy

# A file's tests stay in one process, which makes what they share once; those of tests/slow.txt begin. Each process
# keeps the memory that it freed: Mmg takes up to a third of a gigabyte for a mesh, which the system would clear each time;
# and has it in large pages, where the system lets a process choose, which saves a twentieth of the time.
PYTEST = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MALLOC_MMAP_THRESHOLD_=4294967296 MALLOC_TRIM_THRESHOLD_=4294967296 \
  GLIBC_TUNABLES=glibc.malloc.hugetlb=1 $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

# mypy has one thread: it runs beside the tests, and either of them fails the target.
test: style
	$(BIN)/mypy & types=$$!; \
	$(PYTEST) -m "not acceptance"; tests=$$?; \
	wait $$types && exit $$tests

# The demo, examples, notebooks and experiments as they are documented, and laws that take many estimates to be seen:
# tests of over seven seconds each, a hundredth of all tests. Before a landing or a release.
acceptance: install
	$(PYTEST) -m acceptance

check: test acceptance

# Laws of every layer, in under a minute.
quick: install
	$(PYTEST) -m "not slow"

# A report in a Chromium (BROWSER, else playwright's own or the system's): console, axe-core, keyboard, width.
REPORT ?= demo-output/report.html
AXE := build/axe/package/axe.min.js
report-check: install $(AXE)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[browser]"
	$(BIN)/python benchmarks/report_check.py $(REPORT) --axe $(AXE) --pictures build/report-check \
	  $(if $(BROWSER),--browser $(BROWSER))

$(AXE):
	mkdir -p build/axe
	cd build/axe && npm pack --silent axe-core@4 && tar xzf axe-core-*.tgz

# Every figure that README and docs state, and their pictures, into docs/figures.json and the pages: about two hours on
# two quiet cores. PARTS="demo examples" runs some parts alone, PARTS=text none: it writes what the file says. BODIES=6
# takes more bodies for accuracy, mismatch and coverage, and as many times as long.
figures: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[browser]"
	$(BIN)/python benchmarks/figures.py $(PARTS) $(if $(BODIES),--bodies $(BODIES)) $(if $(BROWSER),--browser $(BROWSER))

# case.schema.json, which the package ships, from the dataclasses that read a case.
schemas: install
	$(BIN)/python -c "import json; from palpate.case.json_schema import SCHEMAS, case_schema; \
	  (SCHEMAS / 'case.schema.json').write_text(json.dumps(case_schema(), indent=1) + '\n')"

# The site in build/site; a link that leads nowhere ends it.
docs: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# requirements.lock, which pins what the Dockerfile installs: the libraries, some extras, and what builds the wheel.
LOCKED := dicom mesh itk dataframe samples cohort
lock: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "uv>=0.5"
	echo hatchling | $(BIN)/uv pip compile pyproject.toml - --quiet --upgrade --universal --python-version 3.11 \
	  --no-header --no-annotate $(addprefix --extra ,$(LOCKED)) --output-file requirements.lock

# Wheel and sdist in dist/.
dist: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "build>=1.2"
	rm -rf dist
	$(BIN)/python -m build --outdir dist .

# The wheel alone in an empty environment: the demo and the problems with known answers in an empty folder away from the
# repository.
dist-test: dist
	rm -rf build/empty build/away
	$(PYTHON) -m venv build/empty
	build/empty/bin/python -m pip install --quiet --disable-pip-version-check dist/*.whl
	mkdir -p build/away
	wheel=$$PWD/build/empty/bin/palpate; cd build/away && $$wheel demo --output out && $$wheel check out/case.toml && \
	  $$wheel verify --quick --output verification

# The quick tests with the oldest versions of all libraries that pyproject.toml allows; old libraries may use what newer
# ones of others have deprecated.
MINIMUM := images mesh mechanics observation report export steps study/test_result.py study/test_new_case.py test_cli.py
minimum: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "uv>=0.5"
	$(BIN)/uv venv --clear --quiet --python $(PYTHON) build/minimum
	$(BIN)/uv pip install --quiet --python build/minimum --resolution lowest-direct --editable ".[dev]"
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 build/minimum/bin/python -m pytest -n 2 \
	  -W default::DeprecationWarning -W default::PendingDeprecationWarning $(addprefix tests/,$(MINIMUM)) \
	  packages/multifrontal/tests

# Every command that README and docs name, in its small form: some fifteen minutes; ends with the first that fails.
commands: install
	rm -rf build/commands && mkdir -p build/commands
	grep -v -e '^#' -e '^needs' benchmarks/small_forms.txt | sed 's#{folder}#build/commands#' | while read -r form; do \
	  echo "$$form"; OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/$$form \
	    > build/commands/last.log 2>&1 < /dev/null || { tail -5 build/commands/last.log; exit 1; }; done

# What other programs make of our exports. Debian's CalculiX is installed where that may be done, and named elsewhere.
RECEIVERS := calculix-ccx
export-check: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[export-check]"
	dpkg -s $(RECEIVERS) > /dev/null 2>&1 || { [ "$$(id -u)" = 0 ] && command -v apt-get > /dev/null && \
	  apt-get update -qq && apt-get install -qq --yes --no-install-recommends $(RECEIVERS) > /dev/null; } || \
	  echo "$(RECEIVERS) is not installed: its lines will have no figure"
	$(BIN)/python -m pytest tests/export/test_notebook.py
	$(BIN)/python benchmarks/export_check.py

clean:
	rm -rf $(VENV) demo-output build dist .mypy_cache .pytest_cache .ruff_cache
