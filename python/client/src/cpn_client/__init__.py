"""Client of CPN's planner: goal image and camera image to robot actions, over zenoh or gRPC."""

from cpn_client.connection import connect, connect_async
from cpn_client.demonstration import write_episode
from cpn_client.environment import connect_from_environment
from cpn_client.episode import AsyncEpisode, Episode
from cpn_client.errors import (
    LateError,
    NoPlannerError,
    PlannerError,
    RefusedError,
    UnavailableError,
    UnreachableError,
)
from cpn_client.image import Image
from cpn_client.plan import Approach, Goal, Model, Plan, Search, StageTimes
from cpn_client.planner import AsyncPlanner, Planner
from cpn_client.recording import recorded_goal, recorded_observation
from cpn_client.transport import Tls

__all__ = [
    "Approach",
    "AsyncEpisode",
    "AsyncPlanner",
    "Episode",
    "Goal",
    "Image",
    "LateError",
    "Model",
    "NoPlannerError",
    "Plan",
    "Planner",
    "PlannerError",
    "RefusedError",
    "Search",
    "StageTimes",
    "Tls",
    "UnavailableError",
    "UnreachableError",
    "connect",
    "connect_async",
    "connect_from_environment",
    "recorded_goal",
    "recorded_observation",
    "write_episode",
]
