import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from numpy.typing import NDArray

from cpn_client import Image
from cpn_export.cli import import_lerobot
from cpn_export.error import ExportError
from cpn_export.lerobot_dataset import write_dataset
from cpn_export.lerobot_import import CHUNK_ROWS, import_dataset
from cpn_export.recording import Episode, Header, read_episode, read_header
from cpn_export.selection import select_recordings
from tests.support import Sample

KEY = "observation.images.front"


def run(dataset: Path | str, out: Path, *, image_key: str = KEY, task: str = "own", **options: Any) -> int:  # noqa: ANN401
    return import_dataset(str(dataset), image_key=image_key, task=task, out=out, **options)


def recorded(folder: Path, seed: int) -> tuple[Header, Episode]:
    header = read_header(folder / f"own/own-{seed}.mcap")
    return header, read_episode(header)


def unscaled(folder: Path, actions: NDArray[np.float32]) -> NDArray[np.float64]:
    scale = json.loads((folder / "action_scale.json").read_text())
    low, high = np.array(scale["min"]), np.array(scale["max"])
    return low + (actions + 1) / 2 * (high - low)


def recordings_as_dataset(folder: Path) -> list[Sample]:
    samples = [Sample("reach", seed, length=length) for seed, length in enumerate((4, CHUNK_ROWS, CHUNK_ROWS + 3))]
    for sample in samples:
        sample.actions *= np.array([0.01, 0.5, 1, 0], np.float32)  # The last is constant.
        sample.write(folder / "data")
    write_dataset(select_recordings(folder / "data"), folder / "lerobot")
    return samples


def make_dataset(folder: Path, *, video: bool = False, fps: int = 10, **features: Any) -> NDArray[np.uint8]:  # noqa: ANN401
    """Makes a dataset of two episodes of 6 rows, and returns their frames, [6, 90, 120, 3], which are the same."""
    image = {"dtype": "video" if video else "image", "shape": (90, 120, 3), "names": ["height", "width", "channels"]}
    features = {KEY: image, "action": {"dtype": "float32", "shape": (1,), "names": None}} | features
    dataset = LeRobotDataset.create("local/own", fps, features, folder, use_videos=video, video_backend="pyav")
    # Smooth, so that the video's compression costs little.
    x, y, t = np.mgrid[0:90, 0:120, 0:6]
    frames = np.stack([x, y, 20 * t], -1).astype(np.uint8).transpose(2, 0, 1, 3)
    for _ in range(2):
        for t, frame in enumerate(frames):
            dataset.add_frame({KEY: frame, "action": np.array([100.0 * t], np.float32), "task": "Own task."})
        dataset.save_episode()
    dataset.finalize()
    return frames


def test_exported_recordings_come_back(tmp_path: Path) -> None:
    samples = recordings_as_dataset(tmp_path)
    out = tmp_path / "own"
    assert run(tmp_path / "lerobot", out, image_key="observation.image") == len(samples)
    for index, sample in enumerate(samples):
        header, episode = recorded(out, index)
        assert (header.control_hz, header.render_spec) == (sample.control_hz, sample.render_spec)
        # A dataset has no frame after the last action.
        np.testing.assert_array_equal(episode.frames, sample.frames[:-1])
        np.testing.assert_array_equal(episode.states, sample.states[:-1, :4])
        np.testing.assert_allclose(unscaled(out, episode.actions), sample.actions[:-1], atol=1e-7)
        assert episode.successes.tolist() == [False] * (sample.length - 1) + [True]
    every = np.concatenate([sample.actions for sample in samples])
    scale = json.loads((out / "action_scale.json").read_text())
    assert (scale["min"], scale["max"]) == (every.min(0).tolist(), every.max(0).tolist())


def test_chosen_episodes_have_the_scale_of_all(tmp_path: Path) -> None:
    samples = recordings_as_dataset(tmp_path)
    for episodes in ([2, 0, 2], [1]):
        count = run(tmp_path / "lerobot", tmp_path / "own", image_key="observation.image", episodes=episodes)
        assert count == len(set(episodes))
    for index, sample in enumerate(samples):
        _, episode = recorded(tmp_path / "own", index)
        np.testing.assert_array_equal(episode.frames, sample.frames[:-1])
        np.testing.assert_allclose(unscaled(tmp_path / "own", episode.actions), sample.actions[:-1], atol=1e-7)


@pytest.mark.parametrize("video", [False, True])
@pytest.mark.parametrize("resize", ["pad", "crop"])
def test_frames_of_a_camera_are_resized(tmp_path: Path, video: bool, resize: Any) -> None:  # noqa: ANN401
    frames = make_dataset(tmp_path / "lerobot", video=video)
    run(tmp_path / "lerobot", tmp_path, resize=resize)
    for seed in range(2):
        header, episode = recorded(tmp_path, seed)
        assert (header.control_hz, header.render_spec) == (10, "")
        wanted = [np.frombuffer(Image.of(frame, resize).data, np.uint8).reshape(84, 84, 3) for frame in frames]
        difference = np.abs(episode.frames.astype(int) - np.stack(wanted)).mean()
        assert difference < 3 if video else difference == 0
        np.testing.assert_allclose(episode.actions[:, 0], np.linspace(-1, 1, 6)[:-1], atol=1e-7)
        assert episode.states.shape == (6, 0)


def test_a_folder_has_one_scale(tmp_path: Path) -> None:
    make_dataset(tmp_path / "one")
    recordings_as_dataset(tmp_path)
    run(tmp_path / "one", tmp_path / "own")
    before = (tmp_path / "own/action_scale.json").read_text()
    with pytest.raises(
        ExportError, match=r"out: expected a folder without recordings of another action scale, got .*own"
    ):
        run(tmp_path / "lerobot", tmp_path / "own", image_key="observation.image", task="other")
    assert (tmp_path / "own/action_scale.json").read_text() == before


def test_wrong_options_are_named(tmp_path: Path) -> None:
    make_dataset(tmp_path / "lerobot")
    source, out = tmp_path / "lerobot", tmp_path / "own"
    with pytest.raises(ExportError, match=r"dataset: expected a LeRobotDataset v3, got .* without meta/info\.json"):
        run(tmp_path, out)
    with pytest.raises(ExportError, match="dataset: expected a LeRobotDataset v3, got nobody/nothing: "):
        run("nobody/nothing", out)
    with pytest.raises(ExportError, match=f"image-key: expected one of {KEY}, got front"):
        run(source, out, image_key="front")
    with pytest.raises(ExportError, match="episodes: expected indices from 0 to 1, got 2"):
        run(source, out, episodes=[0, 2])
    assert not out.exists()
    with pytest.raises(ExportError, match="episode 0: task: expected a name of a-z"):
        run(source, out, task="Own task.")


def test_the_command_imports_and_reports_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_dataset(tmp_path / "lerobot")
    command = ["cpn-import-lerobot", "--dataset", str(tmp_path / "lerobot"), "--image-key", KEY, "--task", "own"]
    command += ["--out", str(tmp_path / "own"), "--crop", "--episodes", "1"]
    monkeypatch.setattr("sys.argv", command)
    import_lerobot()
    assert "own: 1 recordings of own" in capsys.readouterr().out
    assert recorded(tmp_path / "own", 1)[0].steps == 6
    with pytest.raises(SystemExit, match=r"^cpn-import-lerobot: out: .*own-1\.mcap: expected no recording of this"):
        import_lerobot()
