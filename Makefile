# Two commands: `make demo` and `make test`. Both set everything up by themselves in .venv, build, install and log.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: setup demo test bench lint clean

setup:
	@$(PYTHON) tools/setup_environment.py

# make demo [GRAPH=path.g2o [TRUTH=truth.csv] [STAMPS=stamps.txt]]
demo: setup
	@$(BIN)/rotavg demo $(if $(GRAPH),--graph "$(GRAPH)") $(if $(TRUTH),--truth "$(TRUTH)") \
		$(if $(STAMPS),--stamps "$(STAMPS)")

# make test [ARGS="-k node -x"]; without ARGS several files at a time (those over DDS mostly wait, and have few tests each:
# by number of tests they would come last), without the largest graphs
test:
	@$(PYTHON) tools/setup_environment.py --for-tests
	@$(BIN)/python -m pytest $(if $(strip $(ARGS)),$(ARGS),-n 3 --dist loadfile --no-loadscope-reorder -m "not large")

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
