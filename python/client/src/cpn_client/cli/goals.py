"""Commands `goal register`, `goal show` and `goal list`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from cpn_client.cli import store
from cpn_client.cli.arguments import Files, Text
from cpn_client.cli.camera import grab
from cpn_client.cli.connection import Connection
from cpn_client.cli.pictures import picture, read, write_png
from cpn_client.cli.table import print_table
from cpn_client.errors import invalid
from cpn_client.image import Image, Resize
from cpn_client.recording import recorded_goal


def read_goal(source: str, resize: Resize) -> Image:
    """Image of a registered goal, by name or id, or of a file.

    Raises:
        ValueError: If there is neither, or the file is neither an image nor a recording.
    """
    if goal := store.find(source):
        return goal.image
    if not Path(source).exists():
        expected = "an image file, a recording (.mcap), or a name or id of `cpn goal list`"
        raise invalid("GOAL", expected, source)
    return read(source, "GOAL", resize, recorded_goal)


@dataclass(frozen=True)
class RegisterGoals:
    """Registration of goals with the planner, and by name on this machine. The output is their ids."""

    images: Positional[Files] = ()
    """Image files, recordings (.mcap) and folders of recordings."""
    name: Text = ""
    """Name of the goal: letters, digits, - and _. (default: the first 12 digits of its id)"""
    camera: Text = ""
    """V4L2 webcam in place of images: its device or number, for example /dev/video0 or 0."""
    resize: Resize = "pad"
    """Treatment of images that are not square: black bars at the shorter side, or the longer one cut."""

    def run(self, connection: Connection) -> None:
        """Prints the id of each goal, and its source if there are several."""
        if self.name:
            store.check_name(self.name)
        images = self._images()
        if self.name and len(images) > 1:
            raise invalid("--name", "one goal", f"{len(images)} goals")
        with connection.open() as planner:
            for source, image in images:
                goal = planner.goal(image)
                store.keep(self.name or goal.id[:12], goal)
                print(f"{goal.id}  {source}" if len(images) > 1 else goal.id)

    def _images(self) -> list[tuple[str, Image]]:
        if bool(self.images) == bool(self.camera):
            raise invalid("IMAGES", "image files or recordings, or --camera", "both" if self.images else "none")
        if self.camera:
            return [(self.camera, Image.of(grab(self.camera), self.resize))]
        sources = [file for source in self.images for file in _files(source)]
        return [(source, read(source, "IMAGES", self.resize, recorded_goal)) for source in sources]


def _files(source: str) -> list[str]:
    """The file itself, or the recordings in a folder."""
    if not Path(source).is_dir():
        return [source]
    recordings = sorted(str(path) for path in Path(source).rglob("[!.]*.mcap"))
    if not recordings:
        raise invalid("IMAGES", "a folder with recordings (.mcap)", f"{source} without")
    return recordings


@dataclass(frozen=True)
class ShowGoal:
    """Goal as the planner sees it, 84 x 84 pixels."""

    goal: Positional[str]
    """Image file, recording (.mcap), or name or id of a registered goal."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """PNG file to write."""
    resize: Resize = "pad"
    """Treatment of an image that is not square: black bars at the shorter side, or the longer one cut."""

    def run(self, _: Connection) -> None:
        """Writes the PNG file."""
        write_png(self.out, picture(read_goal(self.goal, self.resize)), "--out")


@dataclass(frozen=True)
class ListGoals:
    """Names and ids of the goals that this user registered, with any planner."""

    def run(self, _: Connection) -> None:
        """Prints name and id of each goal."""
        print_table(("name", "id"), [(name, goal.id) for name, goal in store.kept().items()])
