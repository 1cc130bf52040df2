# One verb list. Every verb does its own set-up.

SHELL := bash
TOOLS := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/cpn/tools
UV := $(TOOLS)/bin/uv
WORKER := sim-worker/.venv
EXAMPLES := examples/.venv
CLIENT := python/client/.venv
EXPORT := python/export/.venv
VIEW := python/view/.venv
BENCH := python/bench-peers/.venv
OPENPI := tests/openpi/.venv
TRITON := tests/triton/.venv
KUBERNETES := tests/kubernetes/.venv
STACK := tests/stack/.venv
ADAPTERS := $(addprefix python/,lerobot stable-worldmodel vla-eval)
EXPERIMENT := experiments/leave_one_out/.venv
# Sources of cpn-messages, a dependency of several environments.
MESSAGES := python/messages/pyproject.toml $(wildcard proto/cpn/v1/*.proto)
# Folders of the experiment's committed results, one a profile.
REPORTED := $(sort $(dir $(patsubst %/,%,$(dir $(wildcard docs/results/leave_one_out/*/*/*-*.json)))))
COMPOSE ?= docker-compose
# All code in Python, as seen from sim-worker, whose settings hold for it.
PYTHON := . $(addprefix ../,examples experiments python tests)
export CPN_SIM_WORKER := $(CURDIR)/$(WORKER)/bin/cpn-sim-worker

.DEFAULT_GOAL := help
.PHONY: help bases stack setup system build demo dataset jenga ablations further-tasks experiment experiment-report models sign-models export-lerobot import-lerobot view test test-crash test-swap test-soak test-export test-client test-adapters test-view test-openpi test-triton test-kubernetes test-stack test-bench test-experiment test-shipped fuzz test-fuzz bench-sim bench-train bench-plan bench-stack deny dist lint format clean

help: ## Show the verbs
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

setup: system .libtorch/build-version $(WORKER)/.ready $(EXAMPLES)/.ready ## Fetch libtorch, the graphics libraries and the Python packages

system:
	@scripts/setup-system.sh

$(UV): | system
	python3 -m venv $(TOOLS)
	$(TOOLS)/bin/pip install --quiet --disable-pip-version-check uv

.libtorch/build-version: scripts/setup-libtorch.sh | $(UV)
	PATH="$(TOOLS)/bin:$$PATH" scripts/setup-libtorch.sh

$(WORKER)/.ready: sim-worker/pyproject.toml sim-worker/uv.lock $(MESSAGES) | $(UV)
	cd sim-worker && $(UV) sync --quiet --locked --all-extras
	touch $@

$(EXAMPLES)/.ready: examples/pyproject.toml examples/uv.lock python/client/pyproject.toml $(MESSAGES) | $(UV)
	cd examples && $(UV) sync --quiet --locked
	touch $@

$(CLIENT)/.ready: python/client/pyproject.toml python/client/uv.lock $(MESSAGES) | $(UV)
	cd python/client && $(UV) sync --quiet --locked --all-extras
	touch $@

$(EXPORT)/.ready: python/export/pyproject.toml python/export/uv.lock python/client/pyproject.toml $(MESSAGES) | $(UV)
	cd python/export && $(UV) sync --quiet --locked
	touch $@

$(ADAPTERS:%=%/.venv/.ready): %/.venv/.ready: %/pyproject.toml %/uv.lock python/client/pyproject.toml sim-worker/pyproject.toml $(MESSAGES) | $(UV)
	cd $* && $(UV) sync --quiet --locked
	touch $@

$(VIEW)/.ready: python/view/pyproject.toml python/view/uv.lock $(MESSAGES) | $(UV)
	cd python/view && $(UV) sync --quiet --locked
	touch $@

$(BENCH)/.ready: python/bench-peers/pyproject.toml python/bench-peers/uv.lock | $(UV)
	cd python/bench-peers && $(UV) sync --quiet --locked
	touch $@

$(OPENPI)/.ready: tests/openpi/pyproject.toml tests/openpi/uv.lock $(MESSAGES) | $(UV)
	cd tests/openpi && $(UV) sync --quiet --locked
	touch $@

$(TRITON)/.ready: tests/triton/pyproject.toml tests/triton/uv.lock | $(UV)
	cd tests/triton && $(UV) sync --quiet --locked
	touch $@

$(KUBERNETES)/.ready: tests/kubernetes/pyproject.toml tests/kubernetes/uv.lock | $(UV)
	cd tests/kubernetes && $(UV) sync --quiet --locked
	touch $@

$(STACK)/.ready: tests/stack/pyproject.toml tests/stack/uv.lock $(MESSAGES) | $(UV)
	cd tests/stack && $(UV) sync --quiet --locked
	touch $@

$(EXPERIMENT)/.ready: experiments/leave_one_out/pyproject.toml experiments/leave_one_out/uv.lock | $(UV)
	cd experiments/leave_one_out && $(UV) sync --quiet --locked
	touch $@

build: setup ## Compile the services, optimised, into target/release
	cargo build --release --locked

# Compiled as for `test`, so that a new machine compiles every crate once for both.
demo: setup ## Evaluate CPN, with position dynamics and without, TE-BC and random on three tasks each, and report first-attempt success
	cargo build --workspace --locked
	CPN_PROGRAMS=$(CURDIR)/target/debug $(WORKER)/bin/python experiments/demo.py

dataset: build ## Record 100 demonstrations of each of the 24 tasks, and check them (EPISODES=n for fewer)
	$(WORKER)/bin/python experiments/dataset.py

jenga: build ## The paper's Jenga experiment in the simulated arm: endpoint errors, pokes, a picture of the trajectories
	$(WORKER)/bin/python experiments/jenga/run.py

experiment: build $(EXPERIMENT)/.ready ## Leave each task out, train, evaluate, report; goes on where it was interrupted (PROFILE=smoke|desk|paper, JOBS=n, EXECUTOR=local|slurm)
	$(EXPERIMENT)/bin/python experiments/leave_one_out/run.py --profile $(or $(PROFILE),smoke) \
		--executor $(or $(EXECUTOR),local) --jobs $(or $(JOBS),$(shell nproc))

experiment-report: $(EXPERIMENT)/.ready ## Make the committed reports of the experiment again, from the committed results
	@test -n "$(REPORTED)" || echo "docs/results/leave_one_out: no results yet, no report"
	for results in $(REPORTED); do \
		$(EXPERIMENT)/bin/python experiments/leave_one_out/aggregate.py $$results && \
		$(EXPERIMENT)/bin/python experiments/leave_one_out/report.py $$results || exit 1; \
	done

ablations: build ## Train by the paper's methods and with other losses and dynamics, two seeds each, and evaluate on six tasks left out of training (GROUPS="reported-1 reported-2 reported-3" for the others); goes on where it was interrupted
	$(WORKER)/bin/python experiments/ablations.py $(if $(GROUPS),--groups $(GROUPS))

further-tasks: build ## Evaluate the shipped checkpoints on the 26 tasks of Meta-World without demonstrations; goes on where it was interrupted
	$(WORKER)/bin/python experiments/further_tasks.py

models: build ## Make the shipped checkpoints again: demonstrations, then training
	$(WORKER)/bin/python experiments/models.py

sign-models: | $(UV) ## Sign the shipped checkpoints (KEY=private key in PEM), and write their public key
	@test -f "$(KEY)" || { echo "KEY: expected a file with a private key in PEM, got \"$(KEY)\"" >&2; exit 1; }
	openssl ec -in "$(KEY)" -pubout -out models/cpn-models.pub.pem
	for model in models/*.safetensors; do \
		$(UV) tool run --quiet --from model-signing==1.1.1 --with pyopenssl==26.4.0 model_signing sign key \
			--private_key "$(KEY)" --signature "$$model.sig" "$$model" || exit 1; \
	done

export-lerobot: $(EXPORT)/.ready ## Turn data/demonstrations into a LeRobotDataset (DATASET=folder, OUT=folder)
	$(EXPORT)/bin/cpn-export-lerobot --dataset $(or $(DATASET),data/demonstrations) --out $(or $(OUT),data/lerobot)

view: export CPN_CONNECT := $(or $(CPN_CONNECT),tcp/127.0.0.1:7447)
view: $(VIEW)/.ready ## Show the simulators of a running system in the browser, and print the address (CPN_CONNECT=endpoint, CPN_NAMESPACE=prefix)
	$(VIEW)/bin/cpn-view live

import-lerobot: $(EXPORT)/.ready ## Turn a LeRobotDataset into recordings (DATASET=folder or name, IMAGE_KEY=key of the camera, TASK=name, OUT=folder)
	$(EXPORT)/bin/cpn-import-lerobot --dataset "$(DATASET)" --image-key "$(IMAGE_KEY)" --task "$(TASK)" --out $(or $(OUT),data/own)

bases: ## Make local images under the names of the public base images, where no image registry is reachable
	deploy/bases/make.sh

stack: ## Build the containers, evaluate in them, leave the report in runs/stack (COMPOSE="docker compose" for version 2)
	$(COMPOSE) build
	$(COMPOSE) up --detach
	$(COMPOSE) logs --follow evaluator
	mkdir -p runs && rm -rf runs/stack && docker cp "$$($(COMPOSE) ps --all --quiet evaluator):/report" runs/stack
	exit "$$(docker wait "$$($(COMPOSE) ps --all --quiet evaluator)")"

test: setup ## Everything that must pass
	cargo test --workspace --locked
	cd sim-worker && $(UV) run --quiet pytest --numprocesses auto --dist loadfile

test-crash: setup ## Kill the recorder a hundred times
	cargo test --workspace --locked --test it -- --ignored crash::

test-swap: setup ## Swap checkpoints a thousand times under a steady load of plans
	cargo test --workspace --locked --test it -- --ignored --nocapture swap::

test-soak: setup ## Half an hour of everything at once against one planner: nothing fails, no memory grows
	cargo test --workspace --locked --test it -- --ignored --nocapture soak::

test-export: $(EXPORT)/.ready ## Export recordings with lerobot's own library, load them back and import them
	cd python/export && $(UV) run --quiet basedpyright && $(UV) run --quiet pytest

test-openpi: setup $(OPENPI)/.ready ## Hold the planner to openpi's own client
	cargo test --workspace --locked --test it -- openpi::
	cargo build --workspace --locked --bin cpn-planner --bin cpn-certs
	cd tests/openpi && $(UV) run --quiet basedpyright && $(UV) run --quiet pytest

test-triton: setup $(TRITON)/.ready ## Hold the planner to Triton's own client
	cargo test --workspace --locked --test it -- kserve::
	cargo build --workspace --locked --bin cpn-planner
	cd tests/triton && $(UV) run --quiet basedpyright && $(UV) run --quiet pytest

test-client: setup $(CLIENT)/.ready ## Run the Python client against planners that answer, come late, go away and come back, and the trainer
	cargo build --workspace --locked --bin cpn-planner --bin cpn-trainer
	cd python/client && $(UV) run --quiet basedpyright && CPN_PROGRAMS=$(CURDIR)/target/debug $(UV) run --quiet pytest

test-adapters: setup $(ADAPTERS:%=%/.venv/.ready) ## Run the policies for other frameworks in those, unmodified, against a planner
	cargo build --workspace --locked --bin cpn-planner
	for adapter in $(ADAPTERS); do \
		(cd $$adapter && $(UV) run --quiet basedpyright && CPN_PROGRAMS=$(CURDIR)/target/debug $(UV) run --quiet pytest) || exit 1; \
	done

test-view: system $(WORKER)/.ready $(VIEW)/.ready ## Watch workers and play recordings, and hold what Rerun is sent to what was published
	cd python/view && $(UV) run --quiet basedpyright && $(UV) run --quiet pytest

test-stack: $(STACK)/.ready ## Break the containers in every way while they evaluate: the results stay the same (ONLY=expression)
	if docker info >/dev/null 2>&1; then $(COMPOSE) build; fi
	cd tests/stack && $(UV) run --quiet basedpyright && $(UV) run --quiet pytest $(if $(ONLY),-k "$(ONLY)")

test-kubernetes: $(KUBERNETES)/.ready ## Check the manifests for a cluster, without one
	cd tests/kubernetes && $(UV) run --quiet basedpyright && $(UV) run --quiet pytest

test-bench: $(BENCH)/.ready ## Check the mathematics of the benches' peers, and their harness
	cd python/bench-peers && $(UV) run --quiet basedpyright && $(UV) run --quiet pytest

test-experiment: setup $(EXPERIMENT)/.ready ## Run the experiment's smoke profile, kill it on its way, and check what it leaves
	cargo test --workspace --locked --no-run
	cd experiments/leave_one_out && $(UV) run --quiet basedpyright && CPN_PROGRAMS=$(CURDIR)/target/debug $(UV) run --quiet pytest

test-shipped: build ## Evaluate the shipped checkpoints, and hold README's table to every count
	$(WORKER)/bin/python experiments/shipped.py

fuzz: setup ## Fuzz each decoder of untrusted bytes for ten minutes (FUZZ_SECONDS=n); fails on an input that breaks one
	scripts/fuzz.sh

test-fuzz: export FUZZ_SECONDS := 10
test-fuzz: fuzz ## Fuzz each decoder for ten seconds

bench-sim: build ## Compare frames, steps and demonstrations with stock Meta-World
	cd sim-worker && $(UV) run --quiet benches/sim.py

bench-train: build $(BENCH)/.ready ## Compare training steps with PyTorch and JAX, in an environment of their own (QUICK=1 for a glance)
	$(BENCH)/bin/python -m cpn_bench.train.bench --out runs/bench $(if $(QUICK),--quick) \
		--ours "$(or $(OURS),cargo bench --quiet --workspace --locked --bench train_step --)"

bench-plan: build $(BENCH)/.ready ## Compare plans with PyTorch, JAX and ONNX Runtime, and the service with LitServe (QUICK=1 for a glance)
	$(BENCH)/bin/python -m cpn_bench.plan.bench --out runs/bench $(if $(QUICK),--quick) \
		--ours "$(or $(OURS),cargo bench --quiet --workspace --locked --bench plan --)" \
		--serve "$(or $(SERVE),cargo bench --quiet --workspace --locked --bench serve --)"

bench-stack: $(STACK)/.ready ## Measure the containers: throughput, start-up, recovery, the cost of mutual TLS (QUICK=1 for a glance)
	if docker info >/dev/null 2>&1; then $(COMPOSE) build; fi
	cd tests/stack && $(UV) run --quiet python -m cpn_stack.bench --out $(CURDIR)/runs/bench $(if $(QUICK),--quick)

$(TOOLS)/bin/cargo-deny:
	cargo install --quiet --locked --root $(TOOLS) cargo-deny@0.20.2

dist: | $(UV) ## Build the wheels of the Python client and its messages into dist
	$(UV) build --quiet --wheel --out-dir dist python/messages
	$(UV) build --quiet --wheel --out-dir dist python/client

deny: $(TOOLS)/bin/cargo-deny ## Check licences and sources of dependencies (advisories need GitHub: cargo deny check)
	$(TOOLS)/bin/cargo-deny --locked check licenses bans sources

lint: setup ## Formatting, lints, types
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --features fuzz/fuzzers --locked -- -D warnings
	cargo clippy --package planner --package trainer --no-default-features --locked -- -D warnings
	cd sim-worker && $(UV) run --quiet ruff check $(PYTHON) && $(UV) run --quiet ruff format --check $(PYTHON) && $(UV) run --quiet basedpyright
	for root in proto crates/wire/proto; do $(UV) tool run --quiet --from buf-bin==1.75.0 buf lint $$root || exit 1; done

format: setup ## Lay out all code
	cargo fmt --all
	cd sim-worker && $(UV) run --quiet ruff format $(PYTHON)

clean: ## Remove what was built
	rm -rf target dist $(WORKER) $(EXAMPLES) $(CLIENT) $(EXPORT) $(VIEW) $(BENCH) $(OPENPI) $(TRITON) $(KUBERNETES) $(STACK) $(ADAPTERS:%=%/.venv) $(EXPERIMENT) .libtorch
