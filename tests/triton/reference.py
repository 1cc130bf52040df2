"""Plan by cpn-client, in JSON. It runs in the environment of the examples: Triton's client needs an older protobuf.

examples/.venv/bin/python tests/triton/reference.py ADDRESS MODEL SEED UPDATES, without updates for the model's own.
"""

import json
import sys
from dataclasses import asdict

import cpn_client

address, model, seed, *updates = sys.argv[1:]
search = cpn_client.Search(iterations=int(updates[0])) if updates else None
pictures = {"goal": "examples/goal.png", "observation": "examples/frame.png"}
with cpn_client.connect(address) as planner:
    print(json.dumps(asdict(planner.plan(model=model, seed=int(seed), search=search, **pictures))))
