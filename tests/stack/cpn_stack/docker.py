"""The commands `docker` and Compose."""

import io
import shutil
import subprocess
import tarfile
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

LIMIT_SECONDS = 300.0
"""Longest wait for anything that is expected to happen."""


class DockerError(RuntimeError):
    """A command that failed, with what it wrote."""


def missing() -> str | None:
    """Why containers cannot be run here; None if they can."""
    if shutil.which("docker") is None:
        return "no docker command"
    result = subprocess.run(["docker", "info"], capture_output=True, text=True, check=False)
    if result.returncode:
        return f"no Docker engine answers: {result.stderr.strip()}"
    return None


def docker(*arguments: str, stdin: bytes | None = None) -> str:
    """What the command prints, without blanks around it.

    Raises:
        DockerError: If it fails.
    """
    return _run(["docker", *arguments], stdin).decode(errors="replace").strip()


def compose_command() -> list[str]:
    """`docker compose` where the plug-in is, else docker-compose."""
    plugin = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
    return ["docker", "compose"] if plugin.returncode == 0 else ["docker-compose"]


def _run(command: list[str], stdin: bytes | None = None) -> bytes:
    result = subprocess.run(command, input=stdin, capture_output=True, check=False)
    if result.returncode:
        raise DockerError(f"{' '.join(command)}: {result.stderr.decode(errors='replace').strip()}")
    return result.stdout


def run(command: list[str], environment: dict[str, str]) -> str:
    """What a command prints, in this environment.

    Raises:
        DockerError: If it fails.
    """
    result = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if result.returncode:
        raise DockerError(f"{' '.join(command)}: {result.stderr.strip()}")
    return result.stdout.strip()


def logs(container: str) -> str:
    """Everything that a container wrote, to either stream."""
    result = subprocess.run(["docker", "logs", container], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=True)
    return result.stdout.decode(errors="replace")


def inspect(container: str, field: str) -> str:
    """A field of a container, for example `.State.ExitCode`."""
    return docker("inspect", "--format", f"{{{{{field}}}}}", container)


def read_folder(container: str, path: str) -> dict[str, bytes]:
    """The files below a folder of a container, which need not run, by their paths relative to the folder."""
    archive = _run(["docker", "cp", f"{container}:{path}", "-"])
    files: dict[str, bytes] = {}
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        for member in tar:
            if member.isfile() and (file := tar.extractfile(member)):
                files[member.name.split("/", 1)[-1]] = file.read()
    return files


def write_file(container: str, folder: str, name: str, content: bytes, user: int) -> None:
    """Writes a file into a volume of a container."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        member = tarfile.TarInfo(name)
        member.size, member.uid, member.gid, member.mode = len(content), user, user, 0o644
        tar.addfile(member, io.BytesIO(content))
    docker("cp", "-", f"{container}:{folder}", stdin=buffer.getvalue())


def wait_until(what: str, ask: Callable[[], T | None], pause_seconds: float = 0.25) -> T:
    """The first answer that is neither None nor false.

    Raises:
        TimeoutError: If there is none within LIMIT_SECONDS.
    """
    end = time.monotonic() + LIMIT_SECONDS
    while time.monotonic() < end:
        if answer := ask():
            return answer
        time.sleep(pause_seconds)
    raise TimeoutError(f"expected within {LIMIT_SECONDS:.0f} s: {what}")
