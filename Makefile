# Two commands on a fresh machine: `make train` and `make test`. Both need Python 3.10 or later and make, nothing else.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RECIPE ?= zoo_configs/quad_swarm_flight.yml
STEPS ?= 400000
SEED ?= 0
LOGS ?= logs
EPISODES ?= 500
JOBS ?= $(shell $(PYTHON) -c "import os; print(os.cpu_count() or 1)")
BENCHMARKS ?= planner env training scaling pairs
TEAMS ?= 6 12 16
TEAM_FAMILIES ?= "distance" "event" "cpa" "cpa and stale" "cpa and event" "plan and stale" "plan, or cpa and stale" "two cpa"
POLICIES ?= none full distance:4 "cpa:1.0s:3&soon:0.5|cpa:1.0s:3&stale:4"
PEERS := agilerl benchmarl xuance
ENV ?= mpe2/simple_spread_v3
MAPPO ?= --algo mappo

.PHONY: help install train test quick test-all test-lowest lint docs page bench bench-peers check-peers mappo results results-quick clean
help:  ## show this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

install: $(VENV)/.installed  ## make .venv with the pinned dependencies

# torch comes first and alone, so that no other package can draw in another build of it.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[zoo,plot,render,plants,ray,onnx,record,docs,dev]"
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[ros,mavlink]" || \
		echo "ROS 2 or MAVLink cannot be installed: what needs them is skipped"
	@touch $@

train: install  ## train MADDPG on the swarm, then print the table of policies (STEPS=20000 for a short run)
	$(BIN)/sb3-maddpg train --env QuadSwarm-v0 --conf-file $(RECIPE) --n-timesteps $(STEPS) --seed $(SEED) \
		--log-folder $(LOGS) --tensorboard-log $(LOGS)/tensorboard --progress
	$(BIN)/sb3-maddpg evaluate --policy $(POLICIES) latest:$(LOGS) --scenario all \
		--episodes $(EPISODES) --jobs $(JOBS) --json $(LOGS)/table.json --plot $(LOGS)/plots

test: install  ## ruff, mypy, the site, and the tests that do not take long, side by side
	$(MAKE) --no-print-directory --jobs 3 --output-sync=target quick lint docs

quick: install
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow"

test-all: install  ## the tests that take long: kills, simulators, other engines, releases, studies
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m slow

test-lowest:  ## tests with the lowest versions that pyproject.toml declares, in .venv-lowest (TORCH=2.10: PyTorch's, too)
	PYTHON=$(PYTHON) JOBS=$(JOBS) TORCH=$(TORCH) bash .ci/lowest

lint: install  ## ruff, mypy and spelling
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell

docs: install  ## the documentation site, in docs/_build; a warning is an error
	$(BIN)/sphinx-build --quiet --fresh-env --fail-on-warning --keep-going --builder html docs docs/_build

# Only after changes in envs/quad_swarm/figures/page; the built page is committed.
page:  ## the page of `sb3-maddpg replay` (needs npm)
	cd envs/quad_swarm/figures/page && npm ci --no-audit --no-fund && npm run build

bench: install  ## speed of planner, environment and learner, as tables and as JSON
	for name in $(BENCHMARKS); do $(BIN)/python benchmarks/$$name.py --json $(LOGS)/$$name.json || exit 1; done

STUDY := $(BIN)/python -m studies.swarm
QUICK_PARTS := test teams counts quadrants sweep robustness unseen asking interventions world delays
results: install  ## fly everything that docs/results.md says again: tuned rules and thresholds, test sets, tables and figures (hours)
	$(STUDY).tune_rules --jobs $(JOBS) --json studies/swarm/data/rules.json.gz
	$(STUDY).tune_rules --preset dense --n-robots $(TEAMS) --family $(TEAM_FAMILIES) --jobs $(JOBS) \
		--json studies/swarm/data/team_rules.json.gz
	$(STUDY).tune_thresholds --jobs $(JOBS) --json studies/swarm/data/thresholds.json.gz --write
	$(STUDY).tune_thresholds studies/swarm/data/any_seed*.zip --n-robots $(TEAMS) --jobs $(JOBS) \
		--json studies/swarm/data/thresholds.json.gz --write
	$(STUDY).tune_flight rules --jobs $(JOBS)
	$(STUDY).tune_flight thresholds studies/swarm/data/flight_seed*.zip --jobs $(JOBS)
	$(STUDY).tune_flight rules --up-to 16 --jobs $(JOBS)
	$(STUDY).tune_flight thresholds studies/swarm/data/flight_seed*.zip --up-to 16 --jobs $(JOBS)
	$(STUDY).fly --jobs $(JOBS)
	$(STUDY).ppo --models $(LOGS) --json studies/swarm/data/ppo.json.gz
	$(STUDY).counterfactual --models $(LOGS) --json studies/swarm/data/counterfactual.json.gz
	$(STUDY).report

results-quick: install  ## the same with few episodes and rules, into $(LOGS)/results
	$(STUDY).tune_rules --quick --jobs $(JOBS) --json $(LOGS)/results/rules.json.gz
	$(STUDY).fly $(QUICK_PARTS) --quick --jobs $(JOBS) --out $(LOGS)/results
	$(STUDY).ppo --steps 8192 --episodes 20 --models $(LOGS)/results --json $(LOGS)/results/ppo.json.gz
	$(STUDY).counterfactual --forks 10 --episodes 20 --models $(LOGS)/results --json $(LOGS)/results/counterfactual.json.gz
	$(STUDY).report --data $(LOGS)/results --pages $(LOGS)/results --images $(LOGS)/results

bench-peers: install $(PEERS:%=.bench/%/.installed)  ## training speed against other libraries, each in its own environment
	$(BIN)/python benchmarks/training.py --json benchmarks/results/training.json

check-peers: install $(PEERS:%=.bench/%/.installed)  ## which action spaces the other libraries train on
	$(BIN)/python -m benchmarks.peers.action_spaces --json benchmarks/results/action_spaces.json

mappo: .bench/benchmarl/.installed  ## MAPPO or IPPO of BenchMARL in ENV, as a baseline (MAPPO="--algo ippo --steps 500000")
	.bench/benchmarl/bin/python -m benchmarks.peers.mappo --env $(ENV) $(MAPPO)

.bench/%/.installed: benchmarks/peers/%.txt
	$(PYTHON) -m venv .bench/$*
	.bench/$*/bin/pip install --quiet --disable-pip-version-check $$(grep ^torch== $<)
	.bench/$*/bin/pip install --quiet --disable-pip-version-check -r $<
	@touch $@

clean:  ## remove what the commands above made, but not the logs
	rm -rf $(VENV) .bench build *.egg-info .mypy_cache .ruff_cache .pytest_cache
