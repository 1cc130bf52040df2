"""Folders for datasets in the making."""

import fcntl
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

MARK = ".cpn-export"
"""File in each of our folders, locked as long as the run that made it lives."""


@contextmanager
def workshop(out: Path) -> Iterator[Path]:
    """A new folder beside `out`, which goes away in the end; those of runs that were killed go first.

    Raises:
        OSError: If none can be made.
    """
    _clear(out)
    folder = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".partial", dir=out.parent))
    try:
        with (folder / f"{MARK}.new").open("w") as mark:
            # Some network file systems have no locks: what a killed run leaves there, stays there.
            with suppress(OSError):
                fcntl.flock(mark, fcntl.LOCK_EX)
                # Only now: another run takes a mark without a lock for one of a dead run.
                os.rename(mark.name, folder / MARK)
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _clear(out: Path) -> None:
    for folder in out.parent.glob(f".{glob.escape(out.name)}.*.partial"):
        # Without our mark it is not ours, and with a lock another run is at work in it.
        with suppress(OSError), (folder / MARK).open("r+") as mark:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
