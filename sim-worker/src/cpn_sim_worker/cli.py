"""The command line."""

import logging
from typing import Annotated

import tyro

from cpn_sim_worker.demonstrate import DemonstrateConfig, demonstrate
from cpn_sim_worker.server import ServeConfig, serve

Serve = Annotated[ServeConfig, tyro.conf.subcommand("serve")]
Demonstrate = Annotated[DemonstrateConfig, tyro.conf.subcommand("demonstrate")]


def main() -> None:
    """Runs the subcommand that the arguments name."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    match tyro.cli(Serve | Demonstrate, prog="cpn-sim-worker", config=(tyro.conf.OmitArgPrefixes,)):
        case ServeConfig() as config:
            serve(config)
        case DemonstrateConfig() as config:
            demonstrate(config)
