from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from cpn.v1 import demonstration_pb2, sim_pb2
from cpn_view.error import ViewError
from cpn_view.play import OpenStream, find_recordings, play_recording
from tests.support import (
    Recording,
    actions,
    column,
    demonstration,
    frames,
    pictures,
    plan,
    scalars,
    texts,
    times,
    trial,
)


@pytest.fixture
def into_file(rrd: Path) -> OpenStream:
    """Function that opens streams into the file, instead of a viewer."""

    @contextmanager
    def open_stream(application: str, recording: str) -> Iterator[rr.RecordingStream]:
        stream = rr.RecordingStream(application, recording_id=recording)
        stream.save(rrd)
        yield stream
        stream.disconnect()

    return open_stream


def test_demonstration(tmp_path: Path, rrd: Path, into_file: OpenStream) -> None:
    play_recording(demonstration(tmp_path / "a.mcap"), into_file)
    (entry,) = rr.chunk.RrdReader(rrd).recordings()
    assert (entry.application_id, entry.recording_id) == ("cpn-view-demonstrations", str(tmp_path / "a.mcap"))
    assert column(rrd, "/__properties", "RecordingInfo:name") == [["reach 3"]]
    np.testing.assert_array_equal(pictures(rrd, "/camera"), frames(6))
    np.testing.assert_array_equal(scalars(rrd, "/action"), actions(6, 4)[:5])
    np.testing.assert_array_equal(scalars(rrd, "/reward")[:, 0], np.arange(6) / 2)
    np.testing.assert_array_equal(scalars(rrd, "/success")[:, 0], [0, 0, 0, 0, 1, 1])
    assert times(rrd, "/camera", "time") == [12_500_000 * t for t in range(6)]
    assert times(rrd, "/camera", "step") == list(range(6))
    assert texts(rrd, "/demonstration") == ["reach, seed 3\n6 steps, at 80 Hz"]


def test_trial(tmp_path: Path, rrd: Path, into_file: OpenStream) -> None:
    play_recording(trial(tmp_path / "a.mcap"), into_file)
    (entry,) = rr.chunk.RrdReader(rrd).recordings()
    assert entry.application_id == "cpn-view-trials"
    assert column(rrd, "/__properties", "RecordingInfo:name") == [["reach 1000000 cpn"]]
    np.testing.assert_array_equal(pictures(rrd, "/goal"), frames(1, 9))
    np.testing.assert_array_equal(pictures(rrd, "/camera"), frames(6))
    assert times(rrd, "/camera", "time") == [20_000_000 * t for t in range(6)]

    planned = actions(5, 3, 4)
    np.testing.assert_array_equal(scalars(rrd, "/plan/first_action"), planned[:, 0])
    for number, name in enumerate(("x", "y", "z", "gripper")):
        np.testing.assert_array_equal(scalars(rrd, f"/plan/actions/{name}"), planned[:, :, number])
    np.testing.assert_array_equal(scalars(rrd, "/plan/inner_loss"), [[t + 3, t + 1] for t in range(5)])
    losses = [row[0]["buffer"] for row in column(rrd, "/plan/inner_losses", "BarChart:values")]
    assert losses == [list(plan(t, 3).inner_losses) for t in range(5)]
    np.testing.assert_array_equal(scalars(rrd, "/plan/latent_distance")[:, 0], np.arange(5) / 2)
    np.testing.assert_allclose(scalars(rrd, "/plan/times_ms"), [[1, 2, 3]] * 5)
    assert times(rrd, "/plan/times_ms", "time") == [20_000_000 * t + 5_000_000 for t in range(5)]


def test_folder(tmp_path: Path) -> None:
    for name in ("b/1.mcap", "a/2.mcap", "a/1.mcap", ".hidden/1.mcap", "a/.partial.mcap", "a/notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = [str(path.relative_to(tmp_path)) for path in find_recordings([tmp_path / "b/1.mcap", tmp_path])]
    assert names == ["b/1.mcap", "a/1.mcap", "a/2.mcap", "b/1.mcap"]


def test_no_recordings(tmp_path: Path) -> None:
    with pytest.raises(ViewError, match=f"paths: expected a recording .* got {tmp_path}$"):
        find_recordings([tmp_path])
    with pytest.raises(ViewError, match=r"paths: expected a recording .* got none"):
        find_recordings([])


@pytest.mark.parametrize("cut", [0, 100, -100])
def test_damaged_file(tmp_path: Path, into_file: OpenStream, cut: int) -> None:
    path = demonstration(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(ViewError, match=f"{path}: expected a recording, got"):
        play_recording(path, into_file)


def test_other_file(tmp_path: Path, into_file: OpenStream) -> None:
    Recording(path := tmp_path / "a.mcap", sim_pb2.Frame()).close()
    with pytest.raises(ViewError, match=r"first message: expected one of cpn.v1.RecordedTrial, .* got cpn.v1.Frame"):
        play_recording(path, into_file)


def test_wrong_frame(tmp_path: Path, into_file: OpenStream) -> None:
    recording = Recording(path := tmp_path / "a.mcap", demonstration_pb2.RecordedEpisode())
    recording.frame(frames(1)[0], 0, 0, encoding="bgr8")
    recording.close()
    with pytest.raises(ViewError, match=r"a.mcap: frame.encoding: expected rgb8, got 'bgr8'"):
        play_recording(path, into_file)
