import inspect
import json
from pathlib import Path

import pytest

from cpn_sim_worker import keys

GOLDEN = json.loads(Path(__file__).parents[2].joinpath("tests/golden/keys.json").read_text())


def test_golden_file_covers_every_key() -> None:
    assert set(GOLDEN) == {name for name, _ in inspect.getmembers(keys, inspect.isfunction)}


@pytest.mark.parametrize("name", GOLDEN)
def test_key_is_golden(name: str) -> None:
    assert getattr(keys, name)(**GOLDEN[name]["arguments"]) == GOLDEN[name]["key"]
