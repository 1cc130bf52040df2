"""Plan request with Triton's own client, towards a goal image.

make test-triton makes the environment.
tests/triton/.venv/bin/python examples/plan_triton.py examples/goal.png examples/frame.png
"""

import sys

import numpy as np
from PIL import Image
from tritonclient.grpc import InferenceServerClient, InferInput

goal, frame, address = sys.argv[1], sys.argv[2], sys.argv[3] if len(sys.argv) > 3 else "127.0.0.1:50051"
inputs = [InferInput(name, [84, 84, 3], "UINT8") for name in ("goal", "observation")]
for tensor, path in zip(inputs, (goal, frame), strict=True):
    tensor.set_data_from_numpy(np.asarray(Image.open(path).convert("RGB").resize((84, 84))))
with InferenceServerClient(address) as planner:
    answer = planner.infer("cpn", inputs, parameters={"seed": 0})
plan = answer.as_numpy("plan")
print("apply", plan[0].clip(-1, 1), "of", len(plan), "planned actions")
print("checkpoint", answer.get_response().model_version)
