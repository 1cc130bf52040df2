"""Goals that the user registered, under names.

Each is a PNG file in the folder `goals` of the user's data, `NAME.png`, with its id and render spec as texts, so that a
planner that no longer knows the goal can get it again. A goal is forgotten by deletion of its file.
"""

import re
import sys
from pathlib import Path

import PIL.Image
import platformdirs

from cpn_client.cli.pictures import picture, write_png
from cpn_client.errors import invalid
from cpn_client.image import Image
from cpn_client.plan import Goal

NAME = re.compile(r"[A-Za-z0-9_-]+")
"""Name, which is a file's name; without a dot, so that it is none of an image file or recording."""


def check_name(name: str) -> None:
    """Checks a name.

    Raises:
        ValueError: If it has other characters than letters, digits, - and _.
    """
    if not NAME.fullmatch(name):
        raise invalid("--name", "letters, digits, - and _", repr(name))


def keep(name: str, goal: Goal) -> None:
    """Keeps a goal, in place of another of the name.

    Raises:
        ValueError: If its file cannot be written.
        OSError: If its folder cannot be made.
    """
    file = _folder() / f"{name}.png"
    file.parent.mkdir(parents=True, exist_ok=True)
    write_png(file, picture(goal.image), "--name", id=goal.id, render_spec=goal.image.render_spec)


def kept() -> dict[str, Goal]:
    """Goals by name, in alphabetical order; a file that is no goal is left out, with a warning."""
    goals: dict[str, Goal] = {}
    for file in sorted(_folder().glob("*.png")):
        try:
            goals[file.stem] = _read(file)
        except ValueError as error:
            print(f"cpn: {error}; left out", file=sys.stderr)
    return goals


def find(name_or_id: str) -> Goal | None:
    """Goal of a name or an id; None if there is none.

    Raises:
        ValueError: If its file is no goal.
    """
    if not NAME.fullmatch(name_or_id):
        return None
    file = _folder() / f"{name_or_id}.png"
    if file.exists():
        return _read(file)
    return next((goal for goal in kept().values() if goal.id == name_or_id), None)


def _folder() -> Path:
    return platformdirs.user_data_path("cpn", appauthor=False) / "goals"


def _read(file: Path) -> Goal:
    try:
        image = PIL.Image.open(file)
        return Goal(image.info["id"], Image(image.tobytes(), image.info["render_spec"]))
    except KeyError as error:
        raise invalid(str(file), "a registered goal", f"an image without the text {error}") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise invalid(str(file), "a registered goal", error) from None
