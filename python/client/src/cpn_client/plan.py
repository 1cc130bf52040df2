"""Plans, with what they are asked for with."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

from cpn.v1 import planner_pb2
from cpn_client.image import Image

Action: TypeAlias = tuple[float, ...]
Solver: TypeAlias = Literal["gradient", "cem", "mppi", "hybrid"]


@dataclass(frozen=True)
class Search:
    """Search for the actions."""

    solver: Solver = "gradient"
    """Gradient descent, the cross-entropy method, model predictive path integral control, or the cross-entropy method
    with gradient steps."""
    iterations: int | None = None
    """Updates of the gradient solver, generations of the others, at most 1000; the planner's number if None."""
    samples: int | None = None
    """Plans in each generation, 2 to 4096; the planner's number if None. Not for the gradient solver."""
    anytime: bool = False
    """Search until shortly before the deadline, for the best plan found."""

    def to_proto(self) -> planner_pb2.Search:
        """Message of the search."""
        solver = f"SOLVER_{self.solver.upper()}"
        return planner_pb2.Search(
            solver=solver, iterations=self.iterations, samples=self.samples or 0, anytime=self.anytime
        )


@dataclass(frozen=True)
class Goal:
    """Registered goal image. A planner that no longer knows it gets the image again."""

    id: str
    """SHA-256 of the image, in hex."""
    image: Image


@dataclass(frozen=True)
class Approach:
    """Progress of an episode's hand through its targets, of a model with position dynamics."""

    tried: int
    """Number of targets that were reached or given up."""
    position: tuple[float, ...]
    """[3], position of the hand when it last moved, standardised."""
    plans: int
    """Number of plans since then."""

    def to_proto(self) -> planner_pb2.Approach:
        """Message of the approach."""
        return planner_pb2.Approach(tried=self.tried, position=self.position, plans=self.plans)


@dataclass(frozen=True)
class StageTimes:
    """Time of each stage of a plan, in seconds."""

    queue_seconds: float
    encode_seconds: float
    plan_seconds: float


@dataclass(frozen=True)
class Plan:
    """Planned actions. Tuples convert by `numpy.asarray`."""

    actions: tuple[Action, ...]
    """[horizon, A]."""
    first_action: Action
    """[A], action to apply now: the first, clipped to [-1, 1]."""
    inner_losses: tuple[float, ...]
    """[iterations_run + 1], Huber distance to the goal's embedding, with position dynamics to its first three elements,
    of the approach's target if the request has one, before and after each iteration; empty for methods that do not
    plan.
    """
    latent_distance: float | None
    """Euclidean distance between the observation's and the goal's embedding; None for the random method."""
    times: StageTimes
    model_digest: str
    """SHA-256 of the checkpoint, in hex."""
    goal_id: str
    """Id of the goal image; empty for a position."""
    iterations: int
    """Iterations of the search after which the plan was found."""
    iterations_run: int
    warm_start: tuple[Action, ...]
    """[horizon, A], plan to start the next step's search from; empty for methods that do not plan."""
    approach: Approach | None
    """Approach for the next step's request; None for models without position dynamics, and for a request with a search
    or a warm start."""
    request_bytes: int
    """Size of the request, in bytes."""


@dataclass(frozen=True)
class Model:
    """Served model."""

    name: str
    method: str
    """Method: random, bc, te-bc, te-bc-horizon, upn or cpn."""
    digest: str
    """SHA-256 of the checkpoint, in hex."""
    training_tasks: tuple[str, ...]
    horizon: int
    """Number of actions in a plan."""
    version: int
    """Published version; 0 for a checkpoint that was not published."""
