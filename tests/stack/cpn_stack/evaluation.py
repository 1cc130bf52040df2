"""An evaluation that runs in a container, and its records."""

import json
import re
from dataclasses import dataclass
from typing import Any

from cpn_stack import docker as engine
from cpn_stack.docker import docker, inspect, wait_until

Records = dict[str, dict[str, Any]]
"""Records of trials without times, by path."""


@dataclass(frozen=True)
class Evaluation:
    """A container of `cpn-eval run`."""

    container: str
    folder: str
    """Of the report, in the container."""

    def finished_trials(self) -> int:
        """Trials that its log tells of, those of earlier runs into the same folder included."""
        told = re.findall(r"(\d+) of \d+ trials; successes", self.log())
        return int(told[-1]) if told else 0

    def wait_for_trials(self, count: int) -> None:
        """Waits until so many trials have come to their end.

        Raises:
            RuntimeError: If the evaluation ends before.
        """

        def reached() -> bool:
            if self.finished_trials() >= count:
                return True
            if not self.is_running():
                raise RuntimeError(f"expected an evaluation that runs, got one that ended:\n{self.log()}")
            return False

        wait_until(f"{count} trials are finished", reached)

    def is_running(self) -> bool:
        """Whether it has not come to its end."""
        return inspect(self.container, ".State.Running") == "true"

    def wait(self) -> int:
        """The exit code, 0 if every trial came to its end."""
        wait_until("the evaluation ends", lambda: not self.is_running())
        return int(inspect(self.container, ".State.ExitCode"))

    def log(self) -> str:
        """What it wrote."""
        return engine.logs(self.container)

    def records(self) -> Records:
        """Every record, without times."""
        records: Records = {}
        for path, content in engine.read_folder(self.container, f"{self.folder}/trials").items():
            if path.endswith(".json"):
                record = json.loads(content)
                if record["episode"] is not None:
                    del record["episode"]["mean_times"]
                records[path] = record
        return records

    def summary(self) -> dict[str, Any]:
        """The summary beside the report."""
        return json.loads(engine.read_folder(self.container, self.folder)["summary.json"])

    def kill(self) -> None:
        """Kills it as a crash would."""
        docker("kill", self.container)
