import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

from cpn_export.cli import lerobot
from cpn_export.error import ExportError
from cpn_export.lerobot_dataset import write_dataset
from cpn_export.selection import select_recordings
from cpn_export.workshop import workshop
from tests.support import Sample

COMMAND = str(Path(sys.executable).with_name("cpn-export-lerobot"))


def export(dataset: Path, out: Path, *tasks: str, episodes: int | None = None) -> LeRobotDataset:
    write_dataset(select_recordings(dataset, tasks, episodes), out)
    return LeRobotDataset("local/test", root=out)


def pixels(image: torch.Tensor) -> np.ndarray:
    """Converts LeRobot's image, [3, height, width] in [0, 1], to a recorded frame."""
    return np.asarray((image * 255).round().to(torch.uint8).permute(1, 2, 0))


def test_a_dataset_has_the_contents_of_its_recordings(tmp_path: Path) -> None:
    # Seed 10 comes after 9: the order is by number, not by name.
    samples = [Sample("door-lock", 9, length=6), Sample("door-lock", 10, length=3), Sample("reach", 2, length=4)]
    for sample in reversed(samples):
        sample.write(tmp_path / "data")
    exported = export(tmp_path / "data", tmp_path / "out")

    assert exported.fps == 80
    assert exported.num_episodes == len(samples)
    assert len(exported) == sum(sample.length for sample in samples)
    assert exported.meta.info["render_spec"] == '{"camera":"corner4"}'
    row = 0
    for index, sample in enumerate(samples):
        boundaries = exported.meta.episodes[index]
        assert (boundaries["dataset_from_index"], boundaries["dataset_to_index"]) == (row, row + sample.length)
        for t in range(sample.length):
            item = exported[row]
            np.testing.assert_array_equal(pixels(item["observation.image"]), sample.frames[t])
            np.testing.assert_array_equal(item["observation.state"], sample.states[t, :4])
            np.testing.assert_array_equal(item["observation.environment_state"], sample.states[t])
            np.testing.assert_array_equal(item["action"], sample.actions[t])
            assert item["next.reward"].item() == sample.rewards[t + 1]
            assert item["next.success"].item() == sample.successes[t + 1]
            assert (item["episode_index"].item(), item["frame_index"].item()) == (index, t)
            assert item["timestamp"].item() == pytest.approx(t / 80)
            assert item["task"] == sample.task
            row += 1


def test_goals_lie_beside_the_rows(tmp_path: Path) -> None:
    samples = [Sample("reach", 1), Sample("reach", 2, goal_position=())]
    for sample in samples:
        sample.write(tmp_path / "data")
    out = tmp_path / "out"
    export(tmp_path / "data", out)
    entries = json.loads((out / "meta" / "recordings.json").read_text())
    assert [entry["episode_id"] for entry in entries] == ["reach-1", "reach-2"]
    assert [entry["goal_position"] for entry in entries] == [[0.5, 0.25, 0.125], []]
    for entry, sample in zip(entries, samples, strict=True):
        np.testing.assert_array_equal(Image.open(out / entry["goal_image"]), sample.frames[-1])
    assert "render_spec" in (out / "README.md").read_text()
    assert not (out / "images").exists()


def test_tasks_and_episodes_select_recordings(tmp_path: Path) -> None:
    for task in ("door-lock", "reach"):
        for seed in range(3):
            Sample(task, seed).write(tmp_path / "data")
    exported = export(tmp_path / "data", tmp_path / "out", "reach", episodes=2)
    assert exported.num_episodes == 2
    assert list(exported.meta.tasks.index) == ["reach"]


def test_an_existing_output_is_refused_and_unchanged(tmp_path: Path) -> None:
    Sample("reach", 1).write(tmp_path / "data")
    out = tmp_path / "out"
    out.mkdir()
    with pytest.raises(ExportError, match="out: expected a path where nothing is yet"):
        export(tmp_path / "data", out)
    assert list(out.iterdir()) == []


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_failed_run_leaves_nothing(tmp_path: Path) -> None:
    Sample("reach", 1).write(tmp_path / "data")
    Sample("reach", 2, state_size=12).write(tmp_path / "data")
    with pytest.raises(ExportError, match=r"reach-2\.mcap: expected the sizes of .*reach-1\.mcap"):
        export(tmp_path / "data", tmp_path / "out")
    assert names(tmp_path) == {"data"}


def test_folders_of_a_killed_run_are_removed(tmp_path: Path) -> None:
    Sample("reach", 1).write(tmp_path / "data")
    out = tmp_path / "out"
    program = "import os, sys; from pathlib import Path; from cpn_export.workshop import workshop\n"
    program += "with workshop(Path(sys.argv[1])) as folder: (folder / 'half').touch(); os.kill(os.getpid(), 9)"
    subprocess.run([sys.executable, "-c", program, str(out)], check=False)
    assert len(names(tmp_path)) == 2
    with workshop(out) as at_work:
        assert names(tmp_path) == {"data", at_work.name}
        export(tmp_path / "data", out)
        assert names(tmp_path) == {"data", "out", at_work.name}


@pytest.mark.parametrize("name", ["out.partial", ".out.partial", ".out.mine.partial"])
def test_folders_of_others_are_not_deleted(tmp_path: Path, name: str) -> None:
    Sample("reach", 1).write(tmp_path / "data")
    (tmp_path / name).mkdir()
    (tmp_path / name / "mine").touch()
    export(tmp_path / "data", tmp_path / "out")
    assert (tmp_path / name / "mine").exists()
    assert names(tmp_path) == {"data", "out", name}


def test_a_dangling_link_is_refused_and_unchanged(tmp_path: Path) -> None:
    Sample("reach", 1).write(tmp_path / "data")
    out = tmp_path / "out"
    out.symlink_to("nowhere")
    with pytest.raises(ExportError, match="out: expected a path where nothing is yet"):
        export(tmp_path / "data", out)
    assert out.is_symlink()


@pytest.mark.parametrize("blocks", [4, 64])
def test_a_full_disk_gives_a_one_line_error(tmp_path: Path, blocks: int) -> None:
    """Simulates a full disk by a limit on file sizes, which an image or a table exceeds."""
    Sample("reach", 1, length=40).write(tmp_path / "data")
    command = [COMMAND, "--dataset", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    limited = ["bash", "-c", f'ulimit -f {blocks}; exec "$@"', "bash", *command]
    run = subprocess.run(limited, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert "Traceback" not in run.stderr
    message = run.stderr.splitlines()[-1]
    assert message.startswith(f"cpn-export-lerobot: out: expected room for a dataset at {tmp_path / 'out'}, got ")
    assert message.endswith("File too large")
    assert run.stdout == ""
    assert names(tmp_path) == {"data"}


def test_an_impossible_output_path_is_named(tmp_path: Path) -> None:
    Sample("reach", 1).write(tmp_path / "data")
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match=r"out: expected room for a dataset at .*/file/out, got (Not a|File exists)"):
        export(tmp_path / "data", tmp_path / "file" / "out")


def test_the_command_exports_and_reports_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Sample("reach", 1).write(tmp_path / "data")
    command = ["cpn-export-lerobot", "--dataset", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    monkeypatch.setattr("sys.argv", command)
    lerobot()
    assert "1 episodes, 5 frames" in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", [*command, "--tasks", "reach", "dance"])
    with pytest.raises(SystemExit, match="tasks: expected some of reach, got dance"):
        lerobot()
