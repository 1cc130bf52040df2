"""Reproduction of README's table: the shipped checkpoints on the same variations, and the same counts of successes."""

import json
import re

from lab import ROOT, LabError, evaluate_shipped, main

Counts = dict[tuple[str, str], tuple[int, int]]
"""Successes and trials by task and model."""

README = ROOT / "README.md"
HEADER = "| task | model | task was | successes |"
ROW = re.compile(r"\| (?P<task>[^|]+) \| (?P<model>[^|]+) \| [^|]+ \| (?P<successes>\d+)/(?P<trials>\d+) \|")


def read_table(text: str) -> Counts:
    """Counts of the table with the shipped checkpoints' success rates.

    Raises:
        LabError: If there is none.
    """
    _, found, after = text.partition(HEADER)
    rows = [ROW.match(line) for line in after.partition("\n\n")[0].splitlines()]
    counts = {(row["task"], row["model"]): (int(row["successes"]), int(row["trials"])) for row in rows if row}
    if not found or not counts:
        raise LabError(f"README.md: expected a table with the columns {HEADER} and rows of them, got none")
    return counts


def differences(expected: Counts, got: Counts) -> list[str]:
    """A line for each task and model whose counts are not those expected."""
    cells = [key for key in expected | got if expected.get(key) != got.get(key)]
    return [f"{', '.join(key)}: expected {_count(expected, key)}, got {_count(got, key)}" for key in cells]


def _count(counts: Counts, key: tuple[str, str]) -> str:
    return "{}/{}".format(*counts[key]) if key in counts else "no trials"


def reproduce() -> None:
    """Evaluates every task and model of the table, and compares the counts.

    Raises:
        LabError: If one differs.
    """
    expected, out = read_table(README.read_text()), ROOT / "runs/shipped"
    tasks, models = (dict.fromkeys(names) for names in zip(*expected, strict=True))
    evaluate_shipped(out, models, tasks, trials=max(trials for _, trials in expected.values()))

    rows = json.loads((out / "summary.json").read_text())["rows"]
    got = {(row["task"], row["model"]): (row["successes"], row["trials"]) for row in rows}
    if lines := differences(expected, got):
        raise LabError("\n".join([f"README.md: {len(lines)} of {len(expected)} rows are not reproduced", *lines]))
    print(f"README.md: all {len(expected)} rows are reproduced")


if __name__ == "__main__":
    main(reproduce)
