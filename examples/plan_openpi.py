"""Plan request with openpi's own client, towards a goal image.

make test-openpi makes the environment; the planner is started with --openpi-listen 127.0.0.1:8000.
tests/openpi/.venv/bin/python examples/plan_openpi.py examples/goal.png examples/frame.png
"""

import sys

import numpy as np
from openpi_client.image_tools import resize_with_pad
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from PIL import Image


def read(path: str) -> np.ndarray:
    """Image file as an array, [84, 84, 3], uint8, RGB."""
    return resize_with_pad(np.asarray(Image.open(path).convert("RGB")), 84, 84)


goal, frame, port = sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else 8000
policy = WebsocketClientPolicy("127.0.0.1", port)
plan = policy.infer({"model": "cpn", "goal/image": read(goal), "observation/image": read(frame)})
print("apply", plan["actions"][0], "of", len(plan["actions"]), "planned actions")
print("latent distance", plan["latent_distance"], "after", plan["server_timing"]["infer_ms"], "ms")
