"""What a simulator can host."""

# MuJoCo 3.3.0 ships no stubs for its compiled modules.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Literal, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Transition:
    """What one action led to."""

    state: NDArray[np.float64]
    """[S], what the simulator knows of itself: the hand's position first, in metres, then the gripper's opening."""
    reward: float
    success: bool


@dataclass(frozen=True)
class Camera:
    """A fixed camera of a model."""

    name: str
    flip: Literal["rows", "columns"]
    """The axis to reverse in what GL draws from the bottom up: the columns if the camera hangs upside down."""


class Scene(Protocol):
    """A task's physics, whose variations depend on their seed alone, and its scripted expert."""

    @property
    def camera(self) -> Camera:
        """Where pictures are taken from."""
        ...

    @property
    def libraries(self) -> tuple[str, ...]:
        """Names of the packages that the pictures depend on, besides MuJoCo."""
        ...

    @property
    def revision(self) -> str:
        """Tells apart the scene's own states of development; empty if the version of a library does."""
        ...

    @property
    def action_size(self) -> int:
        """A."""
        ...

    @property
    def action_metres(self) -> float:
        """Displacement of the hand's set point by an action of 1, in metres."""
        ...

    @property
    def control_hz(self) -> float:
        """Actions per second of simulated time."""
        ...

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model."""
        ...

    @property
    def data(self) -> mujoco.MjData:
        """The state of the physics."""
        ...

    @property
    def goal_position(self) -> NDArray[np.float64]:
        """Where the goal of the running variation is, [3] in metres; [0] for tasks whose goal is a picture."""
        ...

    @property
    def solved(self) -> bool:
        """Whether the task is solved in the present state."""
        ...

    @property
    def progress(self) -> float:
        """Progress towards success in the present state, 0 to 1."""
        ...

    def reset(self, seed: int) -> NDArray[np.float64]:
        """Starts the variation that `seed` draws; returns the state, [S].

        Raises:
            SeedError: If there is no such variation.
        """
        ...

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Applies an action, [A] in [-1, 1]."""
        ...

    def expert(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """The scripted expert's next action in a state, [A] in [-1, 1]."""
        ...
