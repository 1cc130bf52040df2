import pytest
from lab import LabError
from shipped import README, differences, read_table


def test_the_table_of_readme_is_read() -> None:
    counts = read_table(README.read_text())
    assert len(counts) == 12
    assert {trials for _, trials in counts.values()} == {20}
    assert counts["door-lock", "random"] == (0, 20)


def test_a_page_without_the_table_is_refused() -> None:
    with pytest.raises(LabError, match=r"README\.md: expected a table with the columns .*, got none"):
        read_table("# CPN")


def test_each_count_that_differs_has_a_line() -> None:
    expected = {("reach", "cpn"): (8, 20), ("reach", "bc"): (1, 20), ("push", "bc"): (0, 20)}
    got = {("reach", "cpn"): (8, 20), ("reach", "bc"): (1, 19), ("reach", "upn"): (3, 20)}
    assert differences(expected, expected) == []
    assert differences(expected, got) == [
        "reach, bc: expected 1/20, got 1/19",
        "push, bc: expected 0/20, got no trials",
        "reach, upn: expected no trials, got 3/20",
    ]
