# make sweep   run the paper sweeps and the small atlas; stores, pictures and report under results/
# make test    lint, types and all tests
# make torture the tests of stores and kernels at length (FIC_SWEEP_TORTURE=1), an hour on two cores, with counts
# make coverage how much of the store, the ledger and the planner the tests run
# make docs    the documentation in HTML, under docs/_build/html
# make picture remake the README's picture
# make figures the paper's figures, and those of a report that has run, under results/figures/
# make atlas   run the library's atlases and draw the gallery; stores, PNG and SVG under results/atlas/
# make gallery the same, and remake docs/gallery.md with its pictures
# make gpu     measure everything on an NVIDIA card, with the packages that are there: tables under results/gpu/
#              make gpu GPU="--only rates --limit 600"; python -m benchmarks.gpu --help lists the options
# make explore-speed  measure the explorer's page in headless Chromium, a minute or two
# make clean   remove the results, as after a change of the program; make distclean the environment and the documentation too
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# run or resume the sweeps $(1) in the folder $(2)
run = for name in $(1); do \
	  if [ -e $(2)/$$name.zarr ]; then $(BIN)/fic-sweep resume $(2)/$$name.zarr; \
	  else $(BIN)/fic-sweep run $$name --out $(2)/$$name.zarr; fi || exit $$?; \
	done
ATLASES := atlas $(addprefix atlas-,period expected impact lost best usual settled errors)

# every branch of what a sweep's numbers hang on; of the rest all but a few
WHOLE := $(addprefix store/,fsync lock ledger opening commit) plan/grid
NEARLY := $(addprefix store/,format create extend verify) runner plan/random_design
STORE_TESTS := tests/store tests/refine tests/test_runner.py tests/spec tests/plan
modules = $(subst $() ,$(comma),$(patsubst %,sweeps/%.py,$(1)))
comma := ,

.PHONY: sweep test lint torture coverage docs picture figures atlas gallery gpu explore-speed clean distclean

sweep: $(VENV)/installed
	@mkdir -p results
	@$(call run,paper-welded paper-contact period-map atlas-small,results)
	@echo "drawing ..."
	@$(BIN)/python -m figures.overview results
	@ls results/*.png
	@$(BIN)/fic-sweep report

test: lint
	$(BIN)/pytest -n 2

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

torture: $(VENV)/installed
	FIC_SWEEP_TORTURE=1 $(BIN)/pytest -s tests/lanes tests/engine/test_bits.py tests/spec/test_any_file.py tests/store

coverage: $(VENV)/installed
	$(BIN)/pytest --cov --cov-report= $(STORE_TESTS)
	$(BIN)/coverage report --fail-under=100 --include=$(call modules,$(WHOLE))
	$(BIN)/coverage report --fail-under=98 --include=$(call modules,$(NEARLY))

# -E: tables follow the program, -W: a warning fails the build, -n: so does a reference to nothing
docs: $(VENV)/installed
	$(BIN)/python -m sphinx -E -W -n --keep-going -q -b html docs docs/_build/html
	@echo docs/_build/html/index.html

picture:
	@[ -e results/atlas-small.zarr ] || $(MAKE) sweep
	$(BIN)/python -m figures.overview results --readme docs/overview.png

figures: $(VENV)/installed
	@echo "drawing the paper's figures ..."
	@$(BIN)/python -m figures.paper
	@# the findings beyond the paper, from the data that fic-sweep report has written
	@$(BIN)/python -m figures.findings
	@ls results/figures/*.png

atlas: $(VENV)/installed
	@mkdir -p results/atlas
	@$(call run,$(ATLASES),results/atlas)
	@echo "drawing ..."
	@$(BIN)/python -m figures.atlas results/atlas
	@ls results/atlas/*.png

gallery: atlas
	@$(BIN)/python -m figures.atlas results/atlas --docs docs

# no installation and no network: the machine with the card may have neither
gpu:
	@$(if $(wildcard $(BIN)/python),$(BIN)/python,$(PYTHON)) -m benchmarks.gpu $(GPU)

explore-speed: $(VENV)/installed
	$(BIN)/python -m benchmarks.explorer

$(VENV)/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "fic_jax needs Python 3.11 or newer; make PYTHON=...")'
	@echo "installing into $(VENV), a minute or two ..."
	@$(PYTHON) -m venv $(VENV)
	@# compat: a path entry, so that a folder named fic_jax around it can't shadow the package
	@$(BIN)/pip install --quiet --disable-pip-version-check --config-settings editable_mode=compat \
	  -c constraints.txt -e '.[test,export,bench,fast,dask,docs,explore]'
	@touch $@

clean:
	rm -rf results

distclean: clean
	rm -rf $(VENV) docs/_build
