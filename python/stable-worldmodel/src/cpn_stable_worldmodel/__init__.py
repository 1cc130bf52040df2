"""Policy of stable-worldmodel whose actions are planned by a CPN planner."""

from cpn_stable_worldmodel.policy import PlannerPolicy

__all__ = ["PlannerPolicy"]
