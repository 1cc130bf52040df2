"""Goals from recordings."""

import sys
from pathlib import Path

import pytest
from conftest import FRAME, GOAL
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from mcap_protobuf.writer import Writer

from cpn.v1 import demonstration_pb2, trial_pb2
from cpn_client import Image, Planner, RefusedError, recorded_goal, recorded_observation

SPEC = '{"camera":"corner4"}'


def record(path: Path, *messages: tuple[str, Message]) -> Path:
    with path.open("wb") as stream, Writer(stream) as writer:
        for topic, message in messages:
            writer.write_message(topic, message)
    return path


def frame(image: Image, side: int = 84) -> tuple[str, RawImage]:
    return "/camera", RawImage(width=side, height=side, encoding="rgb8", step=3 * side, data=image.data)


def test_goal_of_a_demonstration_is_its_last_frame(tmp_path: Path) -> None:
    first, last = Image.of(FRAME), Image.of(GOAL)
    episode = demonstration_pb2.RecordedEpisode(render_spec=SPEC)
    path = record(tmp_path / "demonstration.mcap", ("/episode", episode), frame(first), frame(last))
    assert recorded_goal(path) == Image(last.data, SPEC)


def test_goal_of_a_trial_is_its_own(tmp_path: Path) -> None:
    goal = Image(Image.of(GOAL).data, SPEC)
    trial = trial_pb2.RecordedTrial(goal=goal.to_proto())
    assert recorded_goal(record(tmp_path / "trial.mcap", ("/episode", trial), frame(Image.of(FRAME)))) == goal


@pytest.mark.parametrize("variant", ["zenoh-sync"], indirect=True)
def test_goal_of_another_rendering_is_refused_by_the_planner(planner: Planner, tmp_path: Path) -> None:
    goal = Image(Image.of(GOAL).data, SPEC)
    with pytest.raises(RefusedError, match="render_spec"):
        planner.plan(model="cpn", goal=goal, observation=FRAME)


def test_recordings_without_a_frame_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="frame: expected 84 x 84 pixels, got none"):
        recorded_goal(record(tmp_path / "empty.mcap"))
    with pytest.raises(ValueError, match="frame: expected 84 x 84 pixels, got 42 x 42"):
        recorded_goal(record(tmp_path / "small.mcap", frame(Image.of(FRAME), 42)))


def test_observation_is_the_first_frame(tmp_path: Path) -> None:
    episode = demonstration_pb2.RecordedEpisode(render_spec=SPEC)
    trial = trial_pb2.RecordedTrial(goal=Image(Image.of(GOAL).data, SPEC).to_proto())
    frames = frame(Image.of(FRAME)), frame(Image.of(GOAL))
    for first in (episode, trial):
        path = record(tmp_path / "episode.mcap", ("/episode", first), *frames)
        assert recorded_observation(path) == Image(Image.of(FRAME).data, SPEC)
    with pytest.raises(ValueError, match="frame: expected 84 x 84 pixels, got none"):
        recorded_observation(record(tmp_path / "empty.mcap"))


def test_corrupt_recordings_are_refused(tmp_path: Path) -> None:
    path = record(tmp_path / "demonstration.mcap", frame(Image.of(FRAME)), frame(Image.of(GOAL)))
    data = path.read_bytes()
    middle = len(data) // 2
    flipped = data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
    for corrupt in (b"", data[:10], data[:middle], flipped):
        path.write_bytes(corrupt)
        with pytest.raises(ValueError, match=f"^{path}: expected a recording, an MCAP file, got "):
            recorded_goal(path)


def test_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    with pytest.raises(ImportError, match=r"pip install 'cpn-client\[recordings\]'"):
        recorded_goal(tmp_path / "none.mcap")
