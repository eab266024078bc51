# make demo   set up, then render a world, map it and write hybridmap-demo/report.html
# make test   set up, then run the tests
# make check  set up, then format, lint, types, import contracts and declared dependencies
# make setup  leave .venv with the command hybridmap in it (PYTHON=/path/to/python chooses the interpreter)
# make clean  remove what these have written, but for .venv; make distclean: that too
.PHONY: setup test demo check format lint types contracts dependencies clean distclean

BIN := .venv/bin
JOBS ?= 2

setup:
	@tools/setup.sh

demo: setup
	$(BIN)/hybridmap demo --out hybridmap-demo --overwrite

test: setup
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --hypothesis-profile=ci $(TESTS)

check: format lint types contracts dependencies

format: setup
	$(BIN)/ruff format --check hybridmap tests tools

lint: setup
	$(BIN)/ruff check hybridmap tests tools

types: setup
	$(BIN)/mypy

contracts: setup
	$(BIN)/lint-imports

dependencies: setup
	$(BIN)/deptry .

clean:
	rm -rf hybridmap-demo build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find hybridmap tests tools -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf .venv
