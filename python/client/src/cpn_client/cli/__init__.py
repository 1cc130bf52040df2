"""Command line of the client, the program `cpn`."""

import os
import sys

from cpn_client.errors import PlannerError


def main() -> None:
    """Runs the command that the arguments name; an error of it is one line, and exit status 1."""
    try:
        from cpn_client.cli.options import run
    except ModuleNotFoundError as error:
        sys.exit(f"cpn: needs {error.name}: pip install 'cpn-client[cli]'")
    try:
        try:
            run()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # The interpreter flushes once more as it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (PlannerError, ValueError, OSError, ImportError) as error:
        sys.exit(f"cpn: {' '.join(str(error).split())}")
    except KeyboardInterrupt:
        sys.exit(130)
