"""Model server of vla-eval whose actions are planned by a CPN planner."""

from cpn_vla_eval.server import PlannerModelServer

__all__ = ["PlannerModelServer"]
