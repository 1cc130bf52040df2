"""Running episode of a worker: handling of its requests, independent of the transport."""

from dataclasses import dataclass
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from cpn.v1 import sim_pb2, types_pb2
from cpn_sim_worker.expert import ExpertFailedError, solve
from cpn_sim_worker.scene import camera_pose
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.tasks import MissingExtraError, SeedError, UnknownTaskError
from cpn_sim_worker.wire import RequestError, action_from_proto, image_to_proto, invalid


@dataclass(frozen=True)
class _Applied:
    """Latest step, kept to answer a repeated request."""

    action: NDArray[np.float32]
    response: sim_pb2.StepResponse


@dataclass
class _Episode:
    id: str
    goal: types_pb2.Image
    observation: types_pb2.Image
    hand_position: list[float]
    steps: int = 0
    success: bool = False
    done: bool = False
    latest: _Applied | None = None


class EpisodeRunner:
    """Episodes on one simulator, one at a time."""

    def __init__(self, simulator: Simulator, max_steps: int) -> None:
        self._simulator = simulator
        self._max_steps = max_steps
        self._episode: _Episode | None = None

    def reset(self, request: sim_pb2.ResetRequest) -> sim_pb2.ResetResponse:
        """Ends the running episode and starts one of the requested variation."""
        task, seed = request.variation.task, request.variation.seed
        try:
            self._simulator.load(task)
        except UnknownTaskError as error:
            raise invalid("variation.task", error.expected, repr(task)) from None
        except MissingExtraError as error:
            code = types_pb2.ERROR_CODE_FAILED_PRECONDITION
            raise RequestError(code, "variation.task", error.expected, error.got) from None

        self.abandon()
        # Also with another seed's goal, so that the same variations are valid with either goal.
        end = self._solve(task, seed, "variation.seed")
        if request.HasField("goal_seed"):
            end = self._solve(task, request.goal_seed, "goal_seed")
        goal, goal_position = self._frame(), self._simulator.scene.goal_position.tolist()

        state, scene = self._simulator.reset(task, seed), self._simulator.scene
        episode = _Episode(
            id=f"{task}-{seed}-{uuid4().hex[:12]}",
            goal=goal,
            observation=self._frame(),
            hand_position=_hand_position(state),
        )
        self._episode = episode
        return sim_pb2.ResetResponse(
            episode_id=episode.id,
            goal=goal,
            observation=episode.observation,
            max_steps=self._max_steps,
            goal_position=goal_position,
            hand_position=episode.hand_position,
            goal_hand_position=_hand_position(end),
            success=scene.solved,
            progress=scene.progress,
            control=self._control(),
        )

    def step(self, request: sim_pb2.StepRequest) -> tuple[sim_pb2.StepResponse, bool]:
        """Applies an action exactly once; the flag is False for the repeated answer to a repeated request."""
        episode = self._episode
        if episode is None or request.episode_id != episode.id:
            running = "an episode started by a reset" if episode is None else repr(episode.id)
            raise RequestError(types_pb2.ERROR_CODE_NOT_FOUND, "episode_id", running, repr(request.episode_id))

        action = action_from_proto(request.action, self._simulator.scene.action_size, "action")
        latest = episode.latest
        if latest is not None and request.step == episode.steps - 1 and np.array_equal(action, latest.action):
            return latest.response, False
        if episode.done:
            raise RequestError(
                types_pb2.ERROR_CODE_FAILED_PRECONDITION,
                "episode_id",
                "an episode that goes on",
                f"one that ended after {episode.steps} steps",
            )
        if request.step != episode.steps:
            raise RequestError(types_pb2.ERROR_CODE_FAILED_PRECONDITION, "step", episode.steps, request.step)

        transition = self._simulator.step(action)
        episode.steps += 1
        episode.success |= transition.success
        episode.done = episode.success or episode.steps >= self._max_steps
        episode.observation, episode.hand_position = self._frame(), _hand_position(transition.state)
        response = sim_pb2.StepResponse(
            observation=episode.observation,
            reward=transition.reward,
            success=episode.success,
            done=episode.done,
            hand_position=episode.hand_position,
            progress=self._simulator.scene.progress,
        )
        episode.latest = _Applied(action, response)
        return response, True

    def frame(self) -> sim_pb2.Frame | None:
        """Latest frame of the running episode, for watchers; None without an episode."""
        episode, scene = self._episode, self._simulator.scene
        if episode is None:
            return None
        camera = camera_pose(scene)
        return sim_pb2.Frame(
            episode_id=episode.id,
            step=episode.steps,
            image=episode.observation,
            goal=episode.goal,
            success=episode.success or scene.solved,
            progress=scene.progress,
            hand_position=episode.hand_position,
            control=self._control(),
            camera=sim_pb2.CameraPose(
                position=camera.position.tolist(),
                rotation=camera.rotation.ravel().tolist(),
                field_of_view_degrees=camera.field_of_view_degrees,
            ),
        )

    def abandon(self) -> None:
        """Ends the running episode, if any; its further steps are refused."""
        self._episode = None

    def _solve(self, task: str, seed: int, field: str) -> NDArray[np.float64]:
        """Runs the expert; leaves the simulator at the end, and returns the state there, [S].

        `field` names the seed in a `RequestError`.
        """
        try:
            *_, end = solve(self._simulator, task, seed)
        except SeedError as error:
            raise invalid(field, error.expected, error.got) from None
        except ExpertFailedError as error:
            code = types_pb2.ERROR_CODE_FAILED_PRECONDITION
            expected = "a seed whose variation the scripted expert solves"
            raise RequestError(code, field, expected, error.seed) from None
        return end.arrival.state

    def _control(self) -> sim_pb2.Control:
        scene = self._simulator.scene
        return sim_pb2.Control(action_size=scene.action_size, metres=scene.action_metres, hz=scene.control_hz)

    def _frame(self) -> types_pb2.Image:
        return image_to_proto(self._simulator.frame(), str(self._simulator.render_spec))


def _hand_position(state: NDArray[np.float64]) -> list[float]:
    return state[:3].tolist()
