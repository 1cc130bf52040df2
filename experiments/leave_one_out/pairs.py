"""Pictures of pairs of episodes: `pairs.py RESULTS CELLS` reads the trials' recordings, writes RESULTS/pairs.

A pair is a variation that one trained method solved and another did not. Drawn is one pair of a task, of the tasks with
most such variations: the first variation, and the first methods in the order of methods.yaml. A pair is drawn as a
filmstrip (goal picture first, solved episode above) and as an animation of goal, solved and failed episode.
"""

import json
import shutil
import sys
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from typing import Any

from cells import digest
from mcap.reader import NonSeekingReader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image
from results import Cell, Results

Pair = dict[str, Any]  # JSON, of pairs.json.

PAIRS = 6
STRIP_FRAMES = 6
ANIMATION_FRAMES = 25
ANIMATION_MS = 120
"""Time of a frame of an animation."""
QUALITY = 70
"""Of JPEG and WebP."""


def pairs(results: Results, folder: Path) -> Iterator[tuple[Pair, Path, Path]]:
    """The pairs, each with the recordings of the solved and of the failed episode."""
    by_task = {task: list(_candidates(results, task, folder)) for task in results.tasks}
    most_first = sorted(by_task, key=lambda task: -len({pair["seed"] for pair, *_ in by_task[task]}))
    for task in most_first[:PAIRS]:
        yield from by_task[task][:1]


def _candidates(results: Results, task: str, folder: Path) -> Iterator[tuple[Pair, Path, Path]]:
    """Every pair of a task with recordings, by variation."""
    methods = [method for method in results.trained if task in results.common(method)]
    for place, seed in enumerate(results.variations[task]):
        for solved, failed in permutations(methods, 2):
            a, b = (results.cells[task, method][0] for method in (solved, failed))
            if a["successes"][place] > b["successes"][place]:
                above, below = (_recording(folder, cell, seed) for cell in (a, b))
                if above.exists() and below.exists():
                    yield {"task": task, "seed": seed, "solved": solved, "failed": failed}, above, below


def _recording(folder: Path, cell: Cell, seed: int) -> Path:
    """Recording of a trial, in the folder of its evaluation."""
    fold, method = cell["cell"]["fold"], cell["cell"]["method"]
    return folder / "evaluation" / fold / digest(cell["cell"]) / "records/trials" / fold / method / f"{seed}.mcap"


def read_frames(recording: Path) -> tuple[Image.Image, list[Image.Image]]:
    """Goal picture and frames of a trial's recording."""
    goal, frames = None, []
    with recording.open("rb") as file:
        reader = NonSeekingReader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages(topics=["/episode", "/camera"]):
            if channel.topic == "/episode":
                goal = _image(message.goal)
            else:
                frames.append(_image(message))
    if goal is None or not frames:
        raise ValueError(f"{recording}: expected a goal picture and frames, got none")
    return goal, frames


def _image(message: Any) -> Image.Image:  # noqa: ANN401
    return Image.frombytes("RGB", (message.width, message.height), message.data)


def _spread(frames: list[Image.Image], count: int) -> list[Image.Image]:
    """So many frames from the first to the last, evenly spaced."""
    return [frames[k * (len(frames) - 1) // (count - 1)] for k in range(count)]


def _montage(rows: list[list[Image.Image]]) -> Image.Image:
    """The pictures of a table, all of one size."""
    width, height = rows[0][0].size
    picture = Image.new("RGB", (width * len(rows[0]), height * len(rows)))
    for y, row in enumerate(rows):
        for x, image in enumerate(row):
            picture.paste(image, (x * width, y * height))
    return picture


def draw(folder: Path, pair: Pair, solved: Path, failed: Path) -> Pair:
    """Writes the pictures of a pair, and adds their names to it."""
    goal, above = read_frames(solved)
    _, below = read_frames(failed)
    name = f"{pair['task']}-{pair['seed']}"
    strip, animation = f"{name}.jpg", f"{name}.webp"

    rows = [[goal, *_spread(frames, STRIP_FRAMES)] for frames in (above, below)]
    _montage(rows).save(folder / strip, quality=QUALITY, optimize=True)

    # Both run at one speed: the shorter one stays at its end.
    length = max(len(above), len(below))
    above, below = ([*frames, *[frames[-1]] * (length - len(frames))] for frames in (above, below))
    beside = zip(_spread(above, ANIMATION_FRAMES), _spread(below, ANIMATION_FRAMES), strict=True)
    first, *others = [_montage([[goal, a, b]]) for a, b in beside]
    first.save(
        folder / animation,
        save_all=True,
        append_images=others,
        duration=ANIMATION_MS,
        loop=0,
        quality=QUALITY,
        method=6,
    )
    return pair | {"strip": strip, "animation": animation}


def main(results: Path, cells: Path) -> None:
    """Draws the pairs anew, and leaves their list last."""
    folder = results / "pairs"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    drawn = [draw(folder, *pair) for pair in pairs(Results.read(results), cells)]
    (folder / "pairs.json").write_text(json.dumps(drawn, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
