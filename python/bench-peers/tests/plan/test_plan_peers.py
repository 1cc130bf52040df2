"""Plans of the peers against the golden tensors of `tests/golden/reference.py`, and their rollouts."""

from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import plan_stand_in
import pytest
import torch

from cpn_bench.model import read
from cpn_bench.plan import peer_jax, peer_onnx, peer_torch
from cpn_bench.plan.contender import Plans
from cpn_bench.plan.model import PlanModel

GOLDEN = Path(__file__).resolve().parents[4] / "tests/golden"


def by_torch(data: PlanModel) -> Plans:
    planner = peer_torch.Planner(data)
    return planner.plan(data.frames, planner.embed(data.goals))


def by_compiled_torch(data: PlanModel) -> Plans:
    planner = peer_torch.Planner(data)
    # Traced like the peer, without code generation, which takes a minute.
    planner.plan_tensors = torch.compile(planner.traced, fullgraph=True, backend="aot_eager")
    return planner.plan(data.frames, planner.embed(data.goals))


def by_jax(data: PlanModel) -> Plans:
    with jax.enable_x64(True):
        planner = peer_jax.Planner(data)
        return planner.plan(data.frames, planner.embed(data.goals))


@pytest.mark.parametrize("method", ["upn", "cpn"])
@pytest.mark.parametrize("peer", [by_torch, by_compiled_torch, by_jax])
def test_plans_are_golden(peer: Callable[[PlanModel], Plans], method: str) -> None:
    model, weights, tensors = read(GOLDEN / f"{method}.safetensors")
    actions, losses = peer(PlanModel(model, weights, tensors["observations"], tensors["goals"]))
    np.testing.assert_allclose(actions, tensors["actions"], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(losses, tensors["inner_losses"], rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("method", ["upn", "cpn"])
def test_rollouts_of_onnx_and_torch_are_equal(tmp_path: Path, method: str) -> None:
    plan_stand_in.write(tmp_path / "model.safetensors", method)
    data = PlanModel.read(tmp_path / "model.safetensors")
    batch = 3
    onnx = peer_onnx.Planner(data, batch, threads=1)
    planner = peer_torch.Planner(data)
    x, goals = planner.embed(data.frames[:batch]), planner.embed(data.goals[:batch])
    rolled_out, _ = onnx.plan(data.frames[:batch], onnx.embed(data.goals[:batch]))
    np.testing.assert_allclose(rolled_out, planner.agent.rollout(x, goals).numpy(), rtol=1e-5, atol=1e-6)


def test_operations_agree_with_torchs_counter(tmp_path: Path) -> None:
    from torch.utils.flop_counter import FlopCounterMode

    # Without gates, whose products torch does not compute as matrix products.
    plan_stand_in.write(tmp_path / "model.safetensors", "upn")
    data = PlanModel.read(tmp_path / "model.safetensors")
    planner = peer_torch.Planner(data)
    goal = planner.embed(data.goals[:1])
    with FlopCounterMode(display=False) as counter:
        planner.plan(data.frames[:1], goal)
    assert data.operations == counter.get_total_flops()
