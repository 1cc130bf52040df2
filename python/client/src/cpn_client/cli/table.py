"""Plain tables."""

from collections.abc import Iterable, Sequence


def print_table(header: Sequence[str], rows: Iterable[Sequence[str | float]]) -> None:
    """Prints columns with their names above; numbers are right-aligned, those of type float with four decimals."""
    columns = [_aligned(column) for column in zip(header, *rows, strict=True)]
    for line in zip(*columns, strict=True):
        print("  ".join(line).rstrip())


def _aligned(column: Sequence[str | float]) -> list[str]:
    cells = [f"{cell:.4f}" if isinstance(cell, float) else str(cell) for cell in column]
    width = max(map(len, cells))
    return [cell.ljust(width) if isinstance(column[-1], str) else cell.rjust(width) for cell in cells]
