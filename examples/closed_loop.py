"""Closed loop: the simulator in this process, its actions from a planner, until the task is solved.

uv run --project sim-worker --with-editable python/client examples/closed_loop.py plate-slide 1000000
"""

import sys

import numpy as np

import cpn_client
from cpn_sim_worker.expert import solve
from cpn_sim_worker.render import Renderer
from cpn_sim_worker.simulator import Simulator

task, seed, address = sys.argv[1], int(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else "tcp/127.0.0.1:7447"
simulator = Simulator(Renderer())
for _ in solve(simulator, task, seed):
    pass  # The expert's last frame is the goal.
goal = simulator.frame()

simulator.reset(task, seed)
with cpn_client.connect(address) as planner, planner.episode(goal, model="cpn") as episode:
    while episode.steps < 150:
        action = episode.act(simulator.frame())
        if simulator.step(np.asarray(action, np.float32)).success:
            break
    else:
        sys.exit(f"{task} not solved after {episode.steps} actions")
print(f"{task} solved after {episode.steps} actions, {episode.late} of them late")
