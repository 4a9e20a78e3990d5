# Two commands: `make demo` and `make test`. Both set everything up by themselves in .venv, build, install and log.
# `make test-large` runs what takes long by nature and `make test` leaves out.

PYTHON ?= python3
BIN := .venv/bin
AT_A_TIME := -n 3 --dist loadfile --no-loadscope-reorder

.PHONY: setup demo test test-large bench lint clean

setup:
	@$(PYTHON) tools/setup_environment.py

# make demo [GRAPH=path.g2o [TRUTH=truth.csv] [STAMPS=stamps.txt]]
demo: setup
	@$(BIN)/rotavg demo $(if $(GRAPH),--graph "$(GRAPH)") $(if $(TRUTH),--truth "$(TRUTH)") \
		$(if $(STAMPS),--stamps "$(STAMPS)")

# make test [ARGS="-k node -x"]; without ARGS several files at a time (those over DDS mostly wait, and have few tests each:
# by number of tests they would come last), without those of test-large. Each has one thread: several processes' threads
# would wait for each other's cores, and they do so by spinning, which takes several times the time.
test:
	@$(PYTHON) tools/setup_environment.py --for-tests
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(if $(strip $(ARGS)),$(ARGS),$(AT_A_TIME) -m "not large")

# After a change of solver, online or node, and before a release.
test-large:
	@$(PYTHON) tools/setup_environment.py --for-tests
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(AT_A_TIME) -m large

# make bench [ARGS="--minutes 5 --max-pairs 200000"]: beside COLMAP and GTSAM, and the node under load; docs/results/
bench: setup
	@$(BIN)/rotavg benchmark $(ARGS)
	@$(BIN)/rotavg benchmark --soak $(SOAK)

lint: setup
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

clean:
	rm -rf .venv build install log
