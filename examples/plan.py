"""Plan towards a goal image.

examples/.venv/bin/python examples/plan.py examples/goal.png examples/frame.png
"""

import sys

import cpn_client

goal, frame, address = sys.argv[1], sys.argv[2], sys.argv[3] if len(sys.argv) > 3 else "tcp/127.0.0.1:7447"
with cpn_client.connect(address) as planner:
    plan = planner.plan(model="cpn", goal=goal, observation=frame)
print("apply", plan.first_action, "of", len(plan.actions), "planned actions")
print("inner loss", plan.inner_losses, "latent distance", plan.latent_distance)
