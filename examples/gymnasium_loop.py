"""Closed loop over a Gymnasium environment, with actions of a planner.

uv run --project sim-worker --with-editable python/client examples/gymnasium_loop.py plate-slide 1000000
"""

import sys

import gymnasium

import cpn_client

task, seed, address = sys.argv[1], int(sys.argv[2]), sys.argv[3] if len(sys.argv) > 3 else "tcp/127.0.0.1:7447"
env = gymnasium.make(f"cpn_sim_worker.gym:cpn/{task}-v0", goal_image=True)
frame, info = env.reset(seed=seed)
terminated = truncated = False
with cpn_client.connect(address) as planner, planner.episode(info["goal"], model="cpn") as episode:
    while not (terminated or truncated):
        frame, _, terminated, truncated, _ = env.step(episode.act(frame))
env.close()
print(f"{task} {'solved' if terminated else 'not solved'} after {episode.steps} actions")
