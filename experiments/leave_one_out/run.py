"""The experiment: one Snakemake at a time in the folder of its cells.

The lock is the kernel's, and ends with the process however that ends.
"""

import argparse
import fcntl
import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


def names(folder: str) -> list[str]:
    """Names of the files or folders in a folder."""
    return sorted(path.stem for path in (HERE / folder).iterdir())


def main() -> None:
    """Becomes Snakemake, with the options that this program does not know."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--profile", choices=names("profiles"), default="smoke", help="size of the experiment")
    parser.add_argument("--executor", choices=names("executors"), default="local", help="executor of the jobs")
    parser.add_argument("--folder", type=Path, default=ROOT / "runs/leave_one_out", help="folder of the cells")
    arguments, options = parser.parse_known_args()

    arguments.folder.mkdir(parents=True, exist_ok=True)
    lock = os.open(arguments.folder / ".lock", os.O_CREAT | os.O_RDWR)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        sys.exit(f"{arguments.folder}: expected a folder that no run works in, got that of another run")
    os.set_inheritable(lock, True)

    snakemake = Path(sys.executable).with_name("snakemake")
    command = [str(snakemake), "--snakefile", str(HERE / "Snakefile"), "--directory", str(arguments.folder)]
    command += ["--profile", str(HERE / "common")]
    command += ["--workflow-profile", str(HERE / "executors" / arguments.executor)]
    command += ["--configfile", str(HERE / "profiles" / f"{arguments.profile}.yaml")]
    os.execv(snakemake, [*command, *options])


if __name__ == "__main__":
    main()
