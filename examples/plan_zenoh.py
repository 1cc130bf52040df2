"""Plan request over zenoh, towards a goal image.

examples/.venv/bin/python examples/plan_zenoh.py examples/goal.png examples/frame.png
"""

import sys

import zenoh
from PIL import Image

from cpn.v1 import planner_pb2, types_pb2


def read(path: str) -> types_pb2.Image:
    """Image file as a message, 84 x 84 pixels, RGB."""
    image = Image.open(path).convert("RGB").resize((84, 84))
    return types_pb2.Image(height=84, width=84, format=types_pb2.PIXEL_FORMAT_RGB8, data=image.tobytes())


goal, frame, endpoint = sys.argv[1], sys.argv[2], sys.argv[3] if len(sys.argv) > 3 else "tcp/127.0.0.1:7447"
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", f'["{endpoint}"]')
with zenoh.open(config) as session:
    request = planner_pb2.PlanRequest(model="cpn", goal_image=read(goal), observation=read(frame))
    for reply in session.get("cpn/@v1/planner/planner/plan", payload=request.SerializeToString(), timeout=10.0):
        if reply.ok is None:
            sys.exit(str(types_pb2.Error.FromString(reply.err.payload.to_bytes())))
        plan = planner_pb2.PlanResponse.FromString(reply.ok.payload.to_bytes())
        print("apply", list(plan.first_action.values), "of", len(plan.actions), "planned actions")
        print("inner loss", list(plan.inner_losses), "latent distance", plan.latent_distance)
        break
    else:
        sys.exit("no planner answered")
