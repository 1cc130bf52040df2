"""Command line of the simulator worker."""

import logging
import sys
from typing import Annotated

import tyro
import zenoh

from cpn_sim_worker.opengl import OpenGLError, load_mujoco
from cpn_sim_worker.options import DemonstrateConfig, ServeConfig
from cpn_sim_worker.server import serve
from cpn_sim_worker.session import ConfigError

Serve = Annotated[ServeConfig, tyro.conf.subcommand("serve")]
Demonstrate = Annotated[DemonstrateConfig, tyro.conf.subcommand("demonstrate")]


def main() -> None:
    """Runs the subcommand that the arguments name."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    # Zenoh's own log, as set by RUST_LOG.
    zenoh.try_init_log_from_env()
    try:
        match tyro.cli(Serve | Demonstrate, prog="cpn-sim-worker", config=(tyro.conf.OmitArgPrefixes,)):
            case ServeConfig() as config:
                serve(config)
            case DemonstrateConfig() as config:
                # Imported late: it imports MuJoCo, whose OpenGL library may be missing.
                load_mujoco()
                from cpn_sim_worker.demonstrate import demonstrate

                demonstrate(config)
    except (ConfigError, OpenGLError) as error:
        sys.exit(str(error))
