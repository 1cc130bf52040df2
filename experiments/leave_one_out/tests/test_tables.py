import ablations
import further_tasks
import pytest
from lab import ROOT


@pytest.mark.parametrize("table", ablations.tables() + further_tasks.tables())
def test_tables_of_the_results_are_those_of_the_kept_outcomes(table: str) -> None:
    assert table in (ROOT / "docs/results/README.md").read_text()
