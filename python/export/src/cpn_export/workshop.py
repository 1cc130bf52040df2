"""Temporary folders for unfinished datasets."""

import fcntl
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

MARK = ".cpn-export"
"""Marker file in each temporary folder, locked while its run lives."""


@contextmanager
def workshop(out: Path) -> Iterator[Path]:
    """Temporary folder beside `out`, removed at the end; folders of killed runs are removed first.

    Raises:
        OSError: If the folder cannot be created.
    """
    _clear(out)
    folder = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
    try:
        with (folder / f"{MARK}.new").open("w") as mark:
            # Without locks, as on some network file systems, folders of killed runs stay.
            with suppress(OSError):
                fcntl.flock(mark, fcntl.LOCK_EX)
                # Renamed only once locked, since other runs take an unlocked marker for that of a killed run.
                os.rename(mark.name, folder / MARK)
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _clear(out: Path) -> None:
    for folder in out.parent.glob(f".{glob.escape(out.name)}.*.partial"):
        # A folder without the marker is not ours; one with a locked marker is in use.
        with suppress(OSError), (folder / MARK).open("r+") as mark:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
