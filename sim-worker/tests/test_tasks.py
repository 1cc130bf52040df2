# pyright: reportAttributeAccessIssue=false
"""Rule of docs/decisions/0006-task-list.md, as far as it can be checked on the models."""

import mujoco
from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

from cpn_sim_worker.tasks import METAWORLD_TASKS, TASKS

ALL = {name.removesuffix("-v3-goal-observable"): env for name, env in ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE.items()}
NAMED_IN_THE_PAPER = {"coffee-button", "dial-turn", "door-lock", "drawer-close"}
CHOSEN_BY_HAND = {"assembly", "basketball", "coffee-pull", "disassemble", "peg-insert-side", "reach"}


def is_variant(task: str) -> bool:
    """Whether a plainer task of the same name exists."""
    return any(task.startswith(f"{other}-") and task.endswith(("-wall", "-side", "-back")) for other in ALL)


def moves_a_mechanism(task: str) -> bool:
    """Whether nothing in the scene but the arm can move freely."""
    env = ALL[task](seed=0)  # pyright: ignore[reportCallIssue]
    return not (env.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()


def test_list_follows_the_rule() -> None:
    mechanisms = {task for task in ALL if not is_variant(task) and moves_a_mechanism(task)}
    assert set(TASKS) == mechanisms | NAMED_IN_THE_PAPER | CHOSEN_BY_HAND
    assert len(TASKS) == 24


def test_every_task_of_metaworld_is_served() -> None:
    assert sorted(METAWORLD_TASKS) == sorted(ALL)
