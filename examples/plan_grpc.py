"""Plan request over gRPC, towards a registered goal image.

examples/.venv/bin/python examples/plan_grpc.py examples/goal.png examples/frame.png
"""

import sys

import grpc
from PIL import Image

from cpn.v1 import planner_pb2, planner_pb2_grpc, types_pb2


def read(path: str) -> types_pb2.Image:
    """Image file as a message, 84 x 84 pixels, RGB."""
    image = Image.open(path).convert("RGB").resize((84, 84))
    return types_pb2.Image(height=84, width=84, format=types_pb2.PIXEL_FORMAT_RGB8, data=image.tobytes())


goal, frame, address = sys.argv[1], sys.argv[2], sys.argv[3] if len(sys.argv) > 3 else "127.0.0.1:50051"
with grpc.insecure_channel(address) as channel:
    planner = planner_pb2_grpc.PlannerServiceStub(channel)
    goal_id = planner.RegisterGoal(planner_pb2.RegisterGoalRequest(image=read(goal))).goal_id
    plan = planner.Plan(planner_pb2.PlanRequest(model="cpn", goal_id=goal_id, observation=read(frame)), timeout=10)
    print("apply", list(plan.first_action.values), "of", len(plan.actions), "planned actions")
    print("inner loss", list(plan.inner_losses), "latent distance", plan.latent_distance)
