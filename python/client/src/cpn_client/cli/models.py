"""Command `models`."""

from dataclasses import dataclass

from cpn_client.cli.connection import Connection
from cpn_client.cli.table import print_table


@dataclass(frozen=True)
class ListModels:
    """Models that the planner serves."""

    def run(self, connection: Connection) -> None:
        """Prints name, method, version, horizon, number of training tasks and digest of each model."""
        with connection.open() as planner:
            models = planner.models()
        rows = [
            (model.name, model.method, model.version, model.horizon, len(model.training_tasks), model.digest)
            for model in models
        ]
        print_table(("name", "method", "version", "horizon", "training tasks", "digest"), rows)
