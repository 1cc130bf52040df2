from pathlib import Path

import pytest

from cpn_export.error import ExportError
from cpn_export.selection import select_recordings
from tests.support import Sample


def test_missing_tasks_and_recordings_are_named(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"dataset: expected a folder, got .*nowhere"):
        select_recordings(tmp_path / "nowhere")
    with pytest.raises(ExportError, match="dataset: expected recordings at"):
        select_recordings(tmp_path)
    Sample("door-lock", 1).write(tmp_path)
    Sample("reach", 1).write(tmp_path)
    with pytest.raises(ExportError, match="tasks: expected some of door-lock, reach, got dance"):
        select_recordings(tmp_path, ("reach", "dance"))
    with pytest.raises(ExportError, match="episodes: expected 2 recordings of reach, got 1"):
        select_recordings(tmp_path, ("reach",), 2)


@pytest.mark.parametrize(
    ("odd", "message"),
    [
        (Sample("reach", 2, control_hz=20.0), r"control_hz: expected 80\.0 as in .*reach-1.*, got 20\.0 in .*reach-2"),
        (Sample("reach", 2, render_spec="{}"), r"render_spec: expected .*corner4.* as in .*, got '{}' in .*reach-2"),
    ],
)
def test_recordings_with_different_settings_are_refused(tmp_path: Path, odd: Sample, message: str) -> None:
    Sample("reach", 1).write(tmp_path)
    odd.write(tmp_path)
    with pytest.raises(ExportError, match=message):
        select_recordings(tmp_path)


def test_a_fractional_control_rate_is_refused(tmp_path: Path) -> None:
    Sample("reach", 1, control_hz=12.5).write(tmp_path)
    with pytest.raises(ExportError, match=r"control_hz: expected a whole number, as LeRobot's fps, got 12\.5"):
        select_recordings(tmp_path)


@pytest.mark.parametrize("place", ["reach/copy.mcap", "reach/reach-1 (1).mcap", "door-lock/reach-1.mcap"])
def test_a_misplaced_recording_is_refused(tmp_path: Path, place: str) -> None:
    kept = Sample("reach", 1).write(tmp_path)
    copied = Sample("reach", 1).write(tmp_path, place)
    with pytest.raises(ExportError) as refusal:
        select_recordings(tmp_path)
    assert str(refusal.value) == f"{copied}: place: expected {kept}, got {copied}"
    copied.unlink()
    assert [header.path for header in select_recordings(tmp_path)] == [kept]


def test_a_duplicate_episode_is_refused(tmp_path: Path) -> None:
    first, second = Sample("reach", 1, digest="00ff"), Sample("reach", 2, digest="00ff")
    paths = [sample.write(tmp_path) for sample in (first, second)]
    with pytest.raises(
        ExportError, match=f"{paths[1]}: digest: expected one that no other has, got 00ff of {paths[0]}"
    ):
        select_recordings(tmp_path)


def test_hidden_names_are_ignored(tmp_path: Path) -> None:
    kept = Sample("reach", 1).write(tmp_path)
    for place in ("reach/._reach-1.mcap", ".Trash-1000/reach-1.mcap", ".reach/reach-2.mcap"):
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_bytes(b"\0\5\x16\7")
    (tmp_path / "lost+found").mkdir()
    (tmp_path / "README.md").touch()
    assert [header.path for header in select_recordings(tmp_path)] == [kept]
    with pytest.raises(ExportError, match=r"tasks: expected some of reach, got \.reach"):
        select_recordings(tmp_path, (".reach",))


def test_a_task_without_recordings_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "reach").mkdir()
    (tmp_path / "reach" / "._reach-1.mcap").touch()
    with pytest.raises(ExportError, match="dataset: expected recordings at"):
        select_recordings(tmp_path)
