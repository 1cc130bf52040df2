"""Eager PyTorch planner behind LitServe: requests are observations as raw bytes, answers plans as JSON."""

from pathlib import Path
from typing import Annotated

import litserve
import numpy as np
import torch
import tyro
from fastapi import Body
from numpy.typing import NDArray

from cpn_bench.plan.model import PlanModel
from cpn_bench.plan.peer_torch import Planner

MAX_BATCH = 32
THREADS = 1
"""Threads of PyTorch; the HTTP server has a separate process."""
BATCH_TIMEOUT_SECONDS = 0.001
"""Batching delay. A longer one has no benefit, since requests queue up while a batch is planned."""
Observation = Annotated[bytes, Body(media_type="application/octet-stream")]


class PlanAPI(litserve.LitAPI):
    """Planner towards one goal, the first of the file."""

    def __init__(self, model: Path) -> None:
        super().__init__(max_batch_size=MAX_BATCH, batch_timeout=BATCH_TIMEOUT_SECONDS)
        self.path = model

    def setup(self, device: str) -> None:
        """Loads the model and embeds the goal, in the worker's process."""
        torch.set_num_threads(THREADS)
        data = PlanModel.read(self.path)
        self.planner = Planner(data)
        self.goal = self.planner.embed(data.goals[:1])

    def decode_request(self, request: Observation, **kwargs: object) -> NDArray[np.uint8]:
        """Observation of a request, `[84, 84, 3]`."""
        return np.frombuffer(request, np.uint8).reshape(84, 84, 3)

    def predict(self, x: NDArray[np.uint8], **kwargs: object) -> NDArray[np.float32]:
        """Planned actions `[B, H, A]` for observations `[B, 84, 84, 3]`."""
        return self.planner.plan(x, self.goal.expand(len(x), -1))[0]

    def encode_response(self, output: NDArray[np.float32], **kwargs: object) -> dict[str, list[list[float]]]:
        """Answer with a plan."""
        return {"actions": output.tolist()}


def main(model: Path, port: int) -> None:
    """Serves on the loopback interface."""
    server = litserve.LitServer(PlanAPI(model), accelerator="cpu")
    server.run(host="127.0.0.1", port=port, generate_client_file=False, log_level="warning")


if __name__ == "__main__":
    tyro.cli(main)
