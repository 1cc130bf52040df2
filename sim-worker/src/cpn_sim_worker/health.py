"""Health check of a worker, for containers: whether its liveliness token is visible in the network.

Imports neither simulator nor renderer, since it runs every few seconds.
"""

import os
import sys
import time
from dataclasses import dataclass, field

import tyro
import zenoh

from cpn_sim_worker import keys
from cpn_sim_worker.session import ConfigError, NoRouterError, ZenohConfig, look_in

PATIENCE_SECONDS = 4.0
"""Timeout of the check, without the start of the process."""
PAUSE_SECONDS = 0.1
"""Pause between two queries."""


@dataclass(frozen=True)
class HealthConfig:
    """Exit with 0 if a worker is ready, and with 1 and the reason if not, within five seconds.

    Takes the options and environment variables that the worker was started with.
    """

    worker: str = "w0"
    """Name of the worker."""
    zenoh: ZenohConfig = field(default_factory=ZenohConfig)


def fault(config: HealthConfig, patience_seconds: float = PATIENCE_SECONDS) -> str | None:
    """Reason why the worker is not ready; None if it is."""
    end = time.monotonic() + patience_seconds
    key = keys.sim_alive(config.worker)
    try:
        with look_in(config.zenoh, patience_seconds) as session:
            while (left := end - time.monotonic()) > 0:
                if any(reply.ok is not None for reply in session.liveliness().get(key, timeout=left)):
                    return None
                # A router knows all tokens at once; peers discover each other one by one.
                if session.info.routers_zid():
                    break
                time.sleep(PAUSE_SECONDS)
    except (ConfigError, NoRouterError, zenoh.ZError) as error:
        return str(error)
    return f"nobody in the network holds the liveliness token {key}"


def main() -> None:
    """Runs `cpn-sim-worker-health`."""
    try:
        config = tyro.cli(HealthConfig, prog="cpn-sim-worker-health", config=(tyro.conf.OmitArgPrefixes,))
    except ConfigError as error:
        sys.exit(str(error))
    except SystemExit as end:
        # Docker reserves exit code 2, which invalid arguments would give.
        sys.exit(1 if end.code else 0)
    if reason := fault(config):
        print(f"worker {config.worker} is not ready: {reason}", file=sys.stderr, flush=True)
        # Without the interpreter's shutdown, which a thread inside `zenoh.open` could abort.
        os._exit(1)
