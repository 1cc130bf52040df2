"""Services of an experiment on this machine: peers on the loopback interface, in a namespace of their own."""

import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Self, TypeVar

T = TypeVar("T")

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = Path(os.environ.get("CPN_PROGRAMS", ROOT / "target/release"))
"""Folder of the services' programs; tests use those that were compiled for tests."""
WORKER = Path(sys.executable).parent / "cpn-sim-worker"
STOP_SECONDS = 45.0
"""Longest time from SIGTERM to the end of a service: a trainer saves its runs."""
LOG_LINES = 20


class LabError(RuntimeError):
    """A service or command that ended with an error, with the end of its log."""


class Lab:
    """Services that stop with this context, also on Ctrl-C and SIGTERM.

    The first one listens on a free port, to which the others connect. Each writes its log to a file in `out`.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        with socket.create_server(("127.0.0.1", 0)) as listener:
            self.endpoint = f"tcp/127.0.0.1:{listener.getsockname()[1]}"
        self._environment = dict(os.environ) | {"CPN_NAMESPACE": f"{out.name}-{os.getpid()}"}
        self._services: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit("told to stop"))
        self.out.mkdir(parents=True, exist_ok=True)
        os.environ["CPN_NAMESPACE"] = self._environment["CPN_NAMESPACE"]
        return self

    def __exit__(self, *_: object) -> None:
        for service in self._services.values():
            service.terminate()
        end = time.monotonic() + STOP_SECONDS
        for service in self._services.values():
            try:
                service.wait(max(0.0, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                service.kill()

    def planner(self, models: Path, name: str = "planner") -> None:
        """Starts a planner with the checkpoints of a folder."""
        options = ["--name", name, "--models-dir", str(models), "--grpc-listen", "127.0.0.1:0"]
        self._start(name, [str(PROGRAMS / "cpn-planner"), *options])

    def trainer(self, dataset: Path) -> None:
        """Starts a trainer that records demonstrations into a folder."""
        folders = ["--dataset", str(dataset), "--checkpoints", str(self.out / "none"), "--runs", str(self.out / "none")]
        self._start("trainer", [str(PROGRAMS / "cpn-trainer"), "serve", *folders, "--grpc-listen", "127.0.0.1:0"])

    def worker(self, name: str) -> None:
        """Starts a simulator worker."""
        self._start(name, [str(WORKER), "serve", "--worker", name])

    def _start(self, name: str, command: list[str]) -> None:
        join = "--connect" if self._services else "--listen"
        with self._log(name).open("wb") as log:
            self._services[name] = subprocess.Popen(
                [*command, join, self.endpoint], stderr=log, env=self._environment, cwd=ROOT
            )

    def _log(self, name: str) -> Path:
        return self.out / f"{name}.log"

    def demonstrate(self, *options: str) -> None:
        """Streams expert episodes to the trainer, which keeps them; those that it has are not recorded again.

        Raises:
            LabError: If that fails, or a service ends meanwhile.
        """
        self.run([str(WORKER), "demonstrate", *options, "--connect", self.endpoint])

    def evaluate(self, *options: str) -> None:
        """Runs an evaluation.

        Raises:
            LabError: If that fails, or a service ends meanwhile.
        """
        self.run([str(PROGRAMS / "cpn-eval"), "run", *options, "--connect", self.endpoint])

    def run(self, command: list[str], log: Path | None = None) -> None:
        """Runs a command to its end, with its messages on the terminal or in a file.

        Raises:
            LabError: If it fails, or a service ends meanwhile.
        """
        with (log or Path(os.devnull)).open("wb") as file:
            process = subprocess.Popen(command, stderr=file if log else None, env=self._environment, cwd=ROOT)
            try:
                while process.poll() is None:
                    self._check_services()
                    time.sleep(0.1)
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait(STOP_SECONDS)
        if process.returncode:
            raise LabError(f"{shlex.join(command)}: exit code {process.returncode}{_tail(log)}")

    def _check_services(self) -> None:
        for name, service in self._services.items():
            if service.poll() is not None:
                raise LabError(f"{name} ended with exit code {service.returncode}{_tail(self._log(name))}")


def _tail(log: Path | None) -> str:
    """The end of a log, to stand after a message."""
    if log is None:
        return ""
    lines = log.read_text(errors="replace").splitlines()[-LOG_LINES:]
    return "\n".join([f"; the end of {log}:", *lines])


def train(lab: Lab, out: Path, *options: str) -> None:
    """Trains a checkpoint on one core; an interrupted run resumes.

    Raises:
        LabError: If that fails.
    """
    command = [str(PROGRAMS / "cpn-trainer"), "train", "--threads", "1", "--out", str(out), *options]
    lab.run(command, log=lab.out / f"train-{out.stem}.log")


def evaluate_shipped(out: Path, models: Iterable[str], tasks: Iterable[str], trials: int) -> None:
    """Evaluates shipped checkpoints and controls in closed loop, with a planner and two simulators, in a folder anew.

    Raises:
        LabError: If that fails.
    """
    shutil.rmtree(out, ignore_errors=True)
    with Lab(out) as lab:
        lab.planner(ROOT / "models")
        for worker in ("w0", "w1"):
            lab.worker(worker)
        print(f"To watch: CPN_CONNECT={lab.endpoint} CPN_NAMESPACE={os.environ['CPN_NAMESPACE']} make view", flush=True)
        options = ["--models", ",".join(models), "--tasks", ",".join(tasks), "--trials", str(trials)]
        lab.evaluate("--workers", "2", *options, "--out", str(out))


def on_every_core(work: Callable[[T], None], items: Iterable[T]) -> None:
    """Works on the items side by side, one a core.

    Raises:
        LabError: The first of `work`, after those under way have ended.
    """
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for result in [pool.submit(work, item) for item in items]:
            result.result()


def main(experiment: Callable[[], None]) -> None:
    """Runs an experiment; an error ends it with a message."""
    try:
        experiment()
    except LabError as error:
        sys.exit(str(error))
    except KeyboardInterrupt:
        sys.exit(130)
