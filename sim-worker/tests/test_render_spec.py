import json

import numpy as np
import pytest

from cpn_sim_worker.jenga import JengaScene
from cpn_sim_worker.meshes import Decimation
from cpn_sim_worker.render import TESSELLATION
from cpn_sim_worker.simulator import Simulator

MAX_BYTES = 480
"""Length at which errors truncate a quoted spec."""
DECIMATING = {"mujoco", "fast-simplification", "numpy", "scipy"}


@pytest.mark.parametrize(
    ("task", "library", "revision"), [("reach", "metaworld", ""), ("jenga-poke", "dm_control", JengaScene.revision)]
)
def test_spec_has_all_settings_of_the_pixels(simulator: Simulator, task: str, library: str, revision: str) -> None:
    simulator.load(task)
    text = str(simulator.render_spec)
    assert len(text.encode()) < MAX_BYTES
    spec = json.loads(text)
    assert Decimation(**spec["decimation"]) == Decimation()
    assert tuple(spec["tessellation"]) == TESSELLATION
    assert set(spec["versions"]) == DECIMATING | {library}
    assert spec["revision"] == revision


def test_undecimated_is_mujocos_own_tessellation_too(simulator: Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    simulator.reset("drawer-open", 0)
    light = simulator.frame()
    monkeypatch.setattr(simulator._renderer, "_decimation", None)
    # Another simulator, since the renderer keeps its copy of a scene.
    whole = Simulator(simulator._renderer)
    whole.reset("drawer-open", 0)
    spec, quality = whole.render_spec, whole.scene.model.vis.quality
    assert spec.decimation is None
    assert spec.tessellation == (quality.numquads, quality.numslices, quality.numstacks) != TESSELLATION
    assert set(spec.versions) == {"mujoco", "metaworld"}
    assert np.count_nonzero(whole.frame() != light) > 0
    drawn = whole._renderer._model.vis.quality
    assert (drawn.numquads, drawn.numslices, drawn.numstacks) == spec.tessellation
