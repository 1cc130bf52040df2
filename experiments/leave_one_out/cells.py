"""Cells of the experiment: the settings of every job, and the digest of them that names its folder.

A cell is all that decides a job's output: the settings, the digest of the sources that compute it, and the names of the
cells whose output it reads. Changed settings or sources are another cell in another folder, beside the finished one.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Cell = dict[str, Any]  # JSON.

ROOT = Path(__file__).resolve().parents[2]
SIMULATOR = ("sim-worker/src/cpn_sim_worker", "sim-worker/uv.lock")
METHOD = ("crates/cpn/src", "Cargo.lock")
SOURCES = {
    "demonstrations": SIMULATOR,
    "training": (*METHOD, "crates/recording/src", "services/trainer/src/training"),
    "evaluation": (*METHOD, *SIMULATOR, "services/planner/src", "services/evaluator/src"),
}
"""Files and folders that decide the output of each kind of job."""
SUFFIXES = {".rs", ".py", ".xml", ".lock"}
DIGITS = 16


class ProfileError(ValueError):
    """A profile that names an unknown task or method."""


def digest(value: object) -> str:
    """SHA-256 of the value's canonical JSON, its first 16 hex digits."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:DIGITS]


def source_digest(kind: str, root: Path = ROOT) -> str:
    """Digest of the sources behind a kind of job: of their paths and contents."""
    files: list[Path] = []
    for place in (root / source for source in SOURCES[kind]):
        found = [place] if place.is_file() else [path for path in place.rglob("*") if path.suffix in SUFFIXES]
        if not found:
            raise FileNotFoundError(f"sources of {kind}: expected files in {place}, got none")
        files += found
    contents = {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    return digest(contents)


@dataclass(frozen=True)
class Plan:
    """The cells of a profile, by name."""

    demonstrations: dict[str, Cell]
    """One cell."""
    training: dict[str, Cell]
    evaluation: dict[str, Cell]
    results: dict[tuple[str, str, int], str]
    """Evaluation of each fold, method and training seed; controls have the seed 0 alone.

    METHOD-uN is the method's weights, planned with N updates.
    """


def plan(profile: Mapping[str, Any], all_tasks: Iterable[str]) -> Plan:
    """Cells of a profile that fits its schema.

    Raises:
        ProfileError: If it names an unknown task or method.
    """
    tasks = _known("tasks", profile.get("tasks", all_tasks), all_tasks)
    folds = _known("folds", profile.get("folds", tasks), tasks)
    methods = _known("methods", profile["methods"], profile["recipes"])
    code = {kind: source_digest(kind) for kind in SOURCES}

    recording = {"tasks": sorted(tasks), "episodes": profile["demonstrations"], "code": code["demonstrations"]}
    found = Plan({digest(recording): recording}, {}, {}, {})
    for fold in folds:
        for method in methods:
            recipe = profile["recipes"][method]
            for seed in profile["seeds"] if "preset" in recipe else [0]:
                training = None
                if "preset" in recipe:
                    cell = {
                        "fold": fold,
                        "preset": recipe["preset"],
                        "settings": {**profile["training"], **recipe.get("training", {})},
                        "seed": seed,
                        "demonstrations": digest(recording),
                        "code": code["training"],
                    }
                    training = digest(cell)
                    found.training[training] = cell
                base = {
                    "fold": fold,
                    "method": method,
                    "trials": profile["trials"],
                    "options": recipe.get("evaluation", {}),
                    "training": training,
                    "code": code["evaluation"],
                }
                searches = profile.get("updates", []) if recipe.get("plans") else []
                variants = {f"{method}-u{n}": base | {"options": base["options"] | {"updates": n}} for n in searches}
                for name, cell in {method: base, **variants}.items():
                    found.evaluation[digest(cell)] = cell
                    found.results[fold, name, seed] = digest(cell)
    return found


def _known(key: str, names: Iterable[str], known: Iterable[str]) -> list[str]:
    """The names, each of which must be known."""
    names, known = list(names), list(known)
    for name in names:
        if name not in known:
            raise ProfileError(f"{key}: expected some of {', '.join(known)}, got {name}")
    return names
