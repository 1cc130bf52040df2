import shutil
from pathlib import Path
from typing import Any

import pytest
from cells import ROOT, SOURCES, ProfileError, plan, source_digest

TASKS = ("a", "b", "c")


def profile(**changes: object) -> dict[str, Any]:
    recipes = {"random": {}, "bc": {"preset": "paper-bc"}, "cpn": {"preset": "paper-cpn"}}
    settings = {"training.epochs": 5}
    defaults = {"demonstrations": 2, "training": settings, "methods": list(recipes), "seeds": [0, 1], "trials": 3}
    return {"recipes": recipes, **defaults, **changes}


def test_a_profile_has_a_cell_for_each_fold_method_and_training_seed_and_controls_have_one() -> None:
    found = plan(profile(folds=["a", "c"]), TASKS)
    expected = [(m, s) for m in ("bc", "cpn") for s in (0, 1)] + [("random", 0)]
    assert sorted(found.results) == sorted((fold, *key) for fold in ("a", "c") for key in expected)
    assert len(found.training) == 2 * 2 * 2
    assert set(found.results.values()) == set(found.evaluation)


def test_only_what_decides_a_cell_changes_its_name() -> None:
    before = plan(profile(), TASKS)
    other_folds = plan(profile(folds=["b"], methods=["cpn"], seeds=[1]), TASKS)
    assert other_folds.results["b", "cpn", 1] == before.results["b", "cpn", 1]

    more_trials = plan(profile(trials=4), TASKS)
    assert more_trials.training == before.training
    assert not more_trials.evaluation.keys() & before.evaluation.keys()

    for changes in ({"training": {"training.epochs": 6}}, {"demonstrations": 3}, {"tasks": ["a", "b"]}):
        after = plan(profile(**changes), TASKS)
        assert not after.training.keys() & before.training.keys()
        assert after.results["a", "cpn", 0] != before.results["a", "cpn", 0]
        assert after.results["a", "random", 0] == before.results["a", "random", 0]


def test_a_method_that_plans_is_evaluated_with_each_number_of_updates_and_the_same_weights() -> None:
    before = plan(profile(folds=["a"]), TASKS)
    recipes = {
        "bc": {"preset": "paper-bc"},
        "cpn": {"preset": "paper-cpn", "plans": True, "evaluation": {"samples": 7}},
    }
    methods = {"recipes": recipes, "methods": list(recipes)}
    found = plan(profile(folds=["a"], updates=[0, 20], **methods), TASKS)
    assert found.training == before.training
    assert {method for _, method, _ in found.results} == {"bc", "cpn", "cpn-u0", "cpn-u20"}
    cell = found.evaluation[found.results["a", "cpn-u20", 1]]
    assert (cell["method"], cell["options"]) == ("cpn", {"samples": 7, "updates": 20})
    # Without a number of its own a method stays the same cell.
    assert found.results["a", "cpn", 1] == plan(profile(folds=["a"], **methods), TASKS).results["a", "cpn", 1]


def test_methods_that_differ_in_their_evaluation_share_their_weights() -> None:
    recipes = {"cpn": {"preset": "paper-cpn"}, "cpn-u0": {"preset": "paper-cpn", "evaluation": {"updates": 0}}}
    found = plan(profile(recipes=recipes, methods=["cpn", "cpn-u0"], seeds=[0]), TASKS)
    assert len(found.training) == len(TASKS)
    assert len(found.evaluation) == 2 * len(TASKS)


@pytest.mark.parametrize("key", ["tasks", "folds", "methods"])
def test_an_unknown_name_is_refused(key: str) -> None:
    with pytest.raises(ProfileError, match=f"^{key}: expected some of .*, got nonsense$"):
        plan(profile(**{key: ["nonsense"]}), TASKS)


def test_a_source_that_decides_outputs_is_in_their_digest_and_others_are_not(tmp_path: Path) -> None:
    for source in {source for sources in SOURCES.values() for source in sources}:
        (tmp_path / source).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / source).is_dir():
            shutil.copytree(ROOT / source, tmp_path / source, dirs_exist_ok=True)
        else:
            shutil.copy(ROOT / source, tmp_path / source)
    before = {kind: source_digest(kind, tmp_path) for kind in SOURCES}
    assert before == {kind: source_digest(kind) for kind in SOURCES}

    (tmp_path / "services/trainer/src/training/notes.md").write_text("not compiled")
    assert {kind: source_digest(kind, tmp_path) for kind in SOURCES} == before
    (tmp_path / "services/trainer/src/training/adam.rs").write_text("other code")
    changed = [kind for kind in SOURCES if source_digest(kind, tmp_path) != before[kind]]
    assert changed == ["training"]
