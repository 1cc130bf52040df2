"""One stack: its project, its containers, and what can be done to them."""

import json
import os
import random
import socket
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from cpn_stack import docker as engine
from cpn_stack.docker import docker, inspect, logs, wait_until
from cpn_stack.evaluation import Evaluation

ROOT = Path(__file__).resolve().parents[3]
USER = 10001
"""User of every service."""
SERVICES = ("router", "planner-0", "planner-1", "trainer", "sim-worker")
FURTHER_FILE = "CPN_TEST_COMPOSE_FILE"
"""Environment variable with one more file for Compose, for example of other images."""
PORTS = (
    "CPN_PORT_ROUTER",
    "CPN_PORT_PLANNER_0",
    "CPN_PORT_PLANNER_1",
    "CPN_PORT_OPENPI_0",
    "CPN_PORT_OPENPI_1",
    "CPN_PORT_TRAINER",
    "CPN_PORT_PROMETHEUS",
    "CPN_TEST_PORT_METRICS_0",
    "CPN_TEST_PORT_METRICS_1",
)


def _free_ports(count: int) -> list[int]:
    """Ports that nobody listens on, outside of the range that systems give away by themselves."""
    ports: list[int] = []
    while len(ports) < count:
        port = random.randint(15_000, 32_000)
        with suppress(OSError), socket.create_server(("127.0.0.1", port)):
            ports.append(port)
    return ports


class Stack:
    """A stack of its own: project, volumes, network and ports are shared with nobody."""

    def __init__(self) -> None:
        self.project = f"cpn-stack-{uuid.uuid4().hex[:8]}"
        self.ports: dict[str, int] = dict(zip(PORTS, _free_ports(len(PORTS)), strict=True))
        self._command = [*engine.compose_command(), "--project-name", self.project, "--project-directory", str(ROOT)]
        self.environment = dict(os.environ) | {name: str(port) for name, port in self.ports.items()}
        self.environment["RUST_LOG"] = "info"
        self.environment["CPN_HOSTS"] = "router,planner-0,planner-1,trainer,host-a,host-b"
        self._further: list[str] = []

    def compose(self, *arguments: str, further_file: Path | None = None) -> str:
        """What Compose prints."""
        files = [
            ROOT / "docker-compose.yml",
            ROOT / "tests/stack/compose.yml",
            further_file,
            os.environ.get(FURTHER_FILE),
        ]
        options = [option for file in files if file for option in ("--file", str(file))]
        return engine.run([*self._command, *options, *arguments], self.environment)

    def up(self, *services: str, workers: int = 2) -> None:
        """Starts what does not run, and waits until it is healthy; workers are waited for by who needs them."""
        services = services or SERVICES
        scale = ["--scale", f"sim-worker={workers}"] if "sim-worker" in services else []
        self.compose("up", "--detach", "--no-build", *scale, *services)
        for service in services:
            if service != "sim-worker":
                self.wait_healthy(service)

    def down(self) -> None:
        """Removes everything, volumes too."""
        for name in self._further:
            # Some are gone already.
            with suppress(engine.DockerError):
                docker("rm", "--force", "--volumes", name)
        self.compose("down", "--volumes", "--remove-orphans", "--timeout", "2")

    def containers(self, service: str) -> list[str]:
        """Names of the containers of a service, those of `compose run` left out."""
        labels = {"project": self.project, "service": service, "oneoff": "False"}
        filters = [f"--filter=label=com.docker.compose.{label}={value}" for label, value in labels.items()]
        return sorted(docker("ps", "--all", *filters, "--format", "{{.Names}}").split())

    def container(self, service: str) -> str:
        """Name of the first container of a service."""
        return self.containers(service)[0]

    def wait_healthy(self, service: str) -> None:
        """Waits until a service's own health is good."""
        name = self.container(service)
        wait_until(f"{service} is healthy", lambda: inspect(name, ".State.Health.Status") == "healthy")

    def kill(self, container: str) -> None:
        """Kills a container's processes as a crash would."""
        docker("kill", container)

    def start(self, container: str) -> None:
        """Starts a container that was killed or stopped."""
        docker("start", container)

    def stop(self, container: str, seconds: int = 10) -> int:
        """Sends SIGTERM, after so many seconds SIGKILL; the exit code, which is 137 if that was needed."""
        docker("stop", "--time", str(seconds), container)
        return int(inspect(container, ".State.ExitCode"))

    @contextmanager
    def paused(self, container: str) -> Iterator[None]:
        """Freezes a container's processes for a while."""
        docker("pause", container)
        try:
            yield
        finally:
            docker("unpause", container)

    @contextmanager
    def cut_off(self, container: str) -> Iterator[None]:
        """Takes a container off the network, and puts it back under its names."""
        network = f"{self.project}_stack"
        aliases: list[str] = json.loads(
            inspect(container, f'json (index .NetworkSettings.Networks "{network}").Aliases')
        )
        docker("network", "disconnect", network, container)
        try:
            yield
        finally:
            names = [f"--alias={alias}" for alias in aliases]
            docker("network", "connect", *names, network, container)

    def run(self, service: str, *arguments: str, options: Sequence[str] = ()) -> str:
        """Starts a further container of a service in the background; its name. It is not started again when it ends."""
        name = f"{self.project}-{service}-{uuid.uuid4().hex[:6]}"
        self.compose("run", "--detach", "--no-deps", "--name", name, *options, service, *arguments)
        docker("update", "--restart=no", name)
        self._further.append(name)
        return name

    def evaluate(
        self,
        name: str,
        *,
        tasks: str,
        models: str,
        trials: int,
        planners: str = "planner-0,planner-1",
        workers: int = 2,
        out: str = "/report",
        options: Sequence[str] = (),
    ) -> Evaluation:
        """Starts an evaluation, whose report is kept under this name; one of the same name goes on."""
        arguments = ["run", f"--planner={planners}", f"--workers={workers}", f"--models={models}"]
        arguments += [f"--tasks={tasks}", f"--trials={trials}", "--wait-secs=120", f"--out={out}/{name}"]
        return Evaluation(self.run("evaluator", *arguments, options=options), f"{out}/{name}")

    @contextmanager
    def _certificates(self, role: str) -> Iterator[str]:
        """A container, which never runs, with the certificates of a role at /certificates."""
        name = docker("create", "--volume", f"{self.project}_certificates-{role}:/certificates", "cpn-certs")
        try:
            yield name
        finally:
            docker("rm", name)

    def certificates(self, role: str, folder: Path) -> Path:
        """Copies the certificates of a role out of their volume."""
        with self._certificates(role) as container:
            for file, content in engine.read_folder(container, "/certificates").items():
                (folder / file).write_bytes(content)
        return folder

    def copy_certificates(self, role: str, other: "Stack") -> None:
        """Copies the certificates of a role into the volume of another stack."""
        with self._certificates(role) as mine, other._certificates(role) as theirs:
            for file, content in engine.read_folder(mine, "/certificates").items():
                engine.write_file(theirs, "/certificates", file, content, USER)

    def logs(self, service: str) -> str:
        """What the first container of a service wrote."""
        return logs(self.container(service))
