"""Times of plans over two networks in turn, printed as JSON: `{name: [seconds, ...]}`.

Runs in the worker's image, which has zenoh and the messages: `python - '{"name": ["endpoint", "planner"], ...}' PLANS`.
"""

import json
import sys
import time
from contextlib import ExitStack

import numpy as np
import zenoh

from cpn.v1 import planner_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.session import ZenohConfig, ask, open_session
from cpn_sim_worker.wire import encoding, image_to_proto

MODEL = "cpn"
WARM_UP = 100
TIMEOUT_SECONDS = 30.0


def main() -> None:
    networks: dict[str, tuple[str, str]] = json.loads(sys.argv[1])
    plans = int(sys.argv[2])
    frame, goal = (np.random.default_rng(seed).integers(0, 256, (84, 84, 3), np.uint8) for seed in (0, 1))
    times: dict[str, list[float]] = {name: [] for name in networks}
    with ExitStack() as opened:
        sessions = {
            name: opened.enter_context(open_session(ZenohConfig(connect=(endpoint,))))
            for name, (endpoint, _) in networks.items()
        }
        requests: dict[str, bytes] = {}
        for name, (_, planner) in networks.items():
            register = planner_pb2.RegisterGoalRequest(image=image_to_proto(goal, ""))
            key = keys.planner_register_goal(planner)
            answer = ask(sessions[name], key, register, planner_pb2.RegisterGoalResponse, TIMEOUT_SECONDS)
            request = planner_pb2.PlanRequest(
                model=MODEL, goal_id=answer.goal_id, observation=image_to_proto(frame, ""), seed=1
            )
            requests[name] = request.SerializeToString()
        for number in range(WARM_UP + plans):
            # Neither is always the first.
            for name in list(networks)[:: 1 if number % 2 else -1]:
                key = keys.planner_plan(networks[name][1])
                start = time.perf_counter()
                replies = list(
                    sessions[name].get(
                        key,
                        target=zenoh.QueryTarget.BEST_MATCHING,
                        payload=requests[name],
                        encoding=encoding(planner_pb2.PlanRequest),
                        timeout=TIMEOUT_SECONDS,
                    )
                )
                seconds = time.perf_counter() - start
                if len(replies) != 1 or replies[0].ok is None:
                    sys.exit(f"{name}: expected a plan, got {[reply.err for reply in replies]}")
                if number >= WARM_UP:
                    times[name].append(seconds)
    print(json.dumps(times))


if __name__ == "__main__":
    main()
