"""Interface of the scenes that a simulator hosts."""

# MuJoCo 3.3.0 ships no stubs for its compiled modules.
# pyright: reportAttributeAccessIssue=false

from dataclasses import dataclass
from typing import Literal, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Transition:
    """Outcome of one action."""

    state: NDArray[np.float64]
    """[S], state of the simulator: the hand's position in metres, the gripper's opening, then the scene's own
    values."""
    reward: float
    success: bool


@dataclass(frozen=True)
class Camera:
    """Fixed camera of a model."""

    name: str
    flip: Literal["rows", "columns"]
    """Axis to reverse in GL's images, whose rows start at the bottom: the columns for a camera mounted upside down."""


@dataclass(frozen=True)
class CameraPose:
    """Pose of a camera, with which positions are drawn into its images."""

    position: NDArray[np.float64]
    """[3], in metres."""
    rotation: NDArray[np.float64]
    """[3, 3]; its columns are the image's right, its up, and the direction away from the scene."""
    field_of_view_degrees: float
    """Vertical field of view, in degrees."""


class Scene(Protocol):
    """Physics and scripted expert of a task, with variations that depend on the seed alone."""

    @property
    def camera(self) -> Camera:
        """Camera of the images."""
        ...

    @property
    def libraries(self) -> tuple[str, ...]:
        """Names of the packages that the images depend on, besides MuJoCo."""
        ...

    @property
    def revision(self) -> str:
        """Revision of the scene's own files; empty if the version of a library determines them."""
        ...

    @property
    def action_size(self) -> int:
        """Length A of an action."""
        ...

    @property
    def action_metres(self) -> float:
        """Displacement of the hand's set point by an action of 1, in metres."""
        ...

    @property
    def control_hz(self) -> float:
        """Control rate, in actions per second of simulated time."""
        ...

    @property
    def model(self) -> mujoco.MjModel:
        """Compiled model."""
        ...

    @property
    def data(self) -> mujoco.MjData:
        """State of the physics."""
        ...

    @property
    def goal_position(self) -> NDArray[np.float64]:
        """Goal position of the running variation, [3] in metres; [0] for tasks with a goal image."""
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
        """Starts the variation of `seed`; returns the state, [S].

        Raises:
            SeedError: If the seed has no variation.
        """
        ...

    def step(self, action: NDArray[np.float32]) -> Transition:
        """Applies an action, [A] in [-1, 1]."""
        ...

    def expert(self, state: NDArray[np.float64]) -> NDArray[np.float32]:
        """Next action of the scripted expert in a state, [A] in [-1, 1]."""
        ...


def camera_pose(scene: Scene) -> CameraPose:
    """Pose of a scene's camera in the present state."""
    camera = scene.data.camera(scene.camera.name)
    # A camera mounted upside down, whose images are turned by half a turn.
    turn = np.diag([-1.0, -1.0, 1.0]) if scene.camera.flip == "columns" else np.eye(3)
    field_of_view = float(scene.model.camera(scene.camera.name).fovy[0])
    return CameraPose(camera.xpos.copy(), camera.xmat.reshape(3, 3) @ turn, field_of_view)
