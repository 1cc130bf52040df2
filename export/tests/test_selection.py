from pathlib import Path

import pytest

from cpn_export.error import ExportError
from cpn_export.selection import select_recordings
from tests.support import Sample


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
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
def test_recordings_that_differ_do_not_meet_in_a_dataset(tmp_path: Path, odd: Sample, message: str) -> None:
    Sample("reach", 1).write(tmp_path)
    odd.write(tmp_path)
    with pytest.raises(ExportError, match=message):
        select_recordings(tmp_path)


def test_a_rate_that_is_no_whole_number_is_refused(tmp_path: Path) -> None:
    Sample("reach", 1, control_hz=12.5).write(tmp_path)
    with pytest.raises(ExportError, match=r"control_hz: expected a whole number, as LeRobot's fps, got 12\.5"):
        select_recordings(tmp_path)
