"""Subcommands and their options."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro
from tyro.conf import subcommand

from cpn_client.cli.connection import Connection
from cpn_client.cli.goals import ListGoals, RegisterGoals, ShowGoal
from cpn_client.cli.models import ListModels
from cpn_client.cli.plan import PlanActions


@dataclass(frozen=True)
class Goals:
    """Goals: images of finished tasks."""

    command: (
        Annotated[RegisterGoals, subcommand("register")]
        | Annotated[ShowGoal, subcommand("show")]
        | Annotated[ListGoals, subcommand("list")]
    )

    def run(self, connection: Connection) -> None:
        """Runs the subcommand."""
        self.command.run(connection)


@dataclass(frozen=True)
class Options:
    """Client of CPN's planner: goal image and observation image to robot actions."""

    command: (
        Annotated[PlanActions, subcommand("plan")]
        | Annotated[Goals, subcommand("goal")]
        | Annotated[ListModels, subcommand("models")]
    )
    connection: Connection = field(default_factory=Connection)


def run() -> None:
    """Runs the subcommand of the command line. Wrong options end the process with exit status 2."""
    options = tyro.cli(
        Options,
        prog="cpn",
        config=(
            tyro.conf.CascadeSubcommandArgs,
            tyro.conf.DisallowNone,
            tyro.conf.FlagCreatePairsOff,
            tyro.conf.OmitArgPrefixes,
            tyro.conf.OmitSubcommandPrefixes,
            tyro.conf.PositionalMetavarFromFieldName,
        ),
    )
    options.command.run(options.connection)
