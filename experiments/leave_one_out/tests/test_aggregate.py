import shutil
from pathlib import Path

import pytest
from aggregate import compare, folds, latent_distance, main, mean, rate, summarise, updates
from cells import ROOT
from experiment_results import write
from report import report
from results import Results, ResultsError


def test_a_rate_pools_the_training_seeds_and_has_the_interval_of_wilson(tmp_path: Path) -> None:
    write(tmp_path, "a", "cpn", [1, 0, 0, 1], seed=0)
    write(tmp_path, "a", "cpn", [0, 1, 0, 0], seed=1)
    row = rate(Results.read(tmp_path), "a", "cpn")
    assert (row["successes"], row["trials"], row["training_seeds"]) == (3, 8, 2)
    # statsmodels: proportion_confint(3, 8, method="wilson").
    assert row["interval"] == [0.1368, 0.6943]
    assert row["mean_success_steps"] == 23.3
    assert row["mean_best_progress"] == 0.4


def test_pairs_are_trials_of_one_variation_and_training_seed(tmp_path: Path) -> None:
    for task in ("a", "b"):
        write(tmp_path, task, "random", [0, 0, 0, 1])
        write(tmp_path, task, "cpn", [1, 1, 1, 0])
        write(tmp_path, task, "cpn", [0, 0, 0, 0], seed=1)
    write(tmp_path, "c", "cpn", [1, 1, 1, 1])
    row = compare(Results.read(tmp_path), "random", "cpn")
    assert (row["tasks"], row["pairs"], row["only_a"], row["only_b"]) == (2, 8, 2, 6)
    # Two-sided binomial: 2 (1 + 8 + 28) / 2^8.
    assert row["p"] == 0.289
    assert row["difference"] == 0.25 - 0.375


def test_a_bootstrap_keeps_the_tasks_and_pairs_the_variations(tmp_path: Path) -> None:
    write(tmp_path, "a", "bc", [0, 0, 0, 0])
    write(tmp_path, "b", "bc", [1, 1, 1, 1])
    write(tmp_path, "a", "cpn", [1, 0, 1, 0])
    write(tmp_path, "b", "cpn", [1, 0, 1, 0])
    results = Results.read(tmp_path)
    # Between tasks everything differs, within them nothing.
    assert mean(results, "bc", ["a", "b"])["interval"] == [0.5, 0.5]
    low, high = mean(results, "cpn", ["a", "b"])["interval"]
    assert 0 < low < 0.5 < high < 1
    # Of the same outcomes on the same variations there is no difference, whatever is drawn.
    for task in ("a", "b"):
        write(tmp_path, task, "upn", [1, 0, 1, 0])
    assert compare(Results.read(tmp_path), "upn", "cpn")["interval"] == [0, 0]


def test_training_seeds_widen_the_interval(tmp_path: Path) -> None:
    write(tmp_path, "a", "cpn", [0, 0, 0, 0], seed=0)
    write(tmp_path, "a", "cpn", [1, 1, 1, 1], seed=1)
    assert mean(Results.read(tmp_path), "cpn", ["a"])["interval"] == [0, 1]


def test_results_of_other_variations_are_refused(tmp_path: Path) -> None:
    write(tmp_path, "a", "bc", [0, 0, 0, 0])
    write(tmp_path, "a", "cpn", [0, 0, 0, 0], seeds=[1, 2, 3, 4])
    with pytest.raises(ResultsError, match=r"cpn-0\.json: expected the variations \[1000000, .*, got \[1, 2, 3, 4\]"):
        Results.read(tmp_path)


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ResultsError, match="expected results of at least one cell, got none"):
        Results.read(tmp_path)


def test_the_curve_of_updates_is_over_tasks_with_all_of_them(tmp_path: Path) -> None:
    for task, successes in (("a", [1, 1, 0, 0]), ("b", [1, 0, 0, 0])):
        write(tmp_path, task, "cpn", successes)
        write(tmp_path, task, "cpn", [0, 0, 0, 0], updates=0)
        write(tmp_path, task, "cpn", [1, 1, 1, 1], updates=20)
    write(tmp_path, "c", "cpn", [1, 1, 1, 1])
    write(tmp_path, "a", "te-bc", [1, 0, 0, 0])
    results = Results.read(tmp_path)
    rows = updates(results, "cpn")
    assert [(row["updates"], row["mean"], row["tasks"]) for row in rows] == [(0, 0, 2), (1, 0.375, 2), (20, 1, 2)]
    assert updates(results, "te-bc") == []
    # They are no methods of their own in tables and comparisons, but cells with a cost.
    summary = summarise(results, 3)
    assert summary["methods"] == ["te-bc", "cpn"]
    assert "cpn-u20" in {cell["method"] for cell in summary["cells"]}


def test_latent_distances_are_pooled_over_episodes() -> None:
    cells = [
        {"latent_distance": {"success": [[0, 4.0, 3]], "failure": [[0, 2.0, 1], [5, 1.0, 1]]}},
        {"latent_distance": {"success": [[0, 8.0, 1]], "failure": []}},
    ]
    assert latent_distance(cells) == {"success": [[0, 5.0, 4]], "failure": [[0, 2.0, 1], [5, 1.0, 1]]}


def test_the_folds_of_a_profile_are_known() -> None:
    assert (folds("smoke"), folds("desk")) == (2, 24)


@pytest.mark.parametrize("folder", sorted(ROOT.glob("docs/results/leave_one_out/*")), ids=lambda folder: folder.name)
def test_the_committed_reports_are_those_of_the_committed_results(folder: Path, tmp_path: Path) -> None:
    made = tmp_path / folder.name
    for path in folder.glob("*/*.json"):
        (made / path.parent.name).mkdir(parents=True, exist_ok=True)
        shutil.copy(path, made / path.parent.name)
    if (folder / "pairs").exists():
        shutil.copytree(folder / "pairs", made / "pairs", dirs_exist_ok=True)
    main(made)
    report(made)
    for path in folder.glob("*.*"):
        assert (made / path.name).read_text() == path.read_text(), path.name
