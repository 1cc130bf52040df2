"""An unmodified client of Triton and a planner with the shipped checkpoints."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, Planner
from numpy.typing import NDArray
from tritonclient.grpc import InferInput, InferRequestedOutput, InferResult
from tritonclient.utils import InferenceServerException, np_to_triton_dtype

Tensors = dict[str, NDArray[Any]]
MODELS = ["bc", "cpn", "cpn-position", "random", "te-bc", "upn"]


def infer(planner: Planner, model: str, tensors: Tensors, **options: Any) -> InferResult:
    inputs = []
    for name, array in tensors.items():
        inputs.append(InferInput(name, array.shape, np_to_triton_dtype(array.dtype)))
        inputs[-1].set_data_from_numpy(array)
    return planner.triton.infer(model, inputs, client_timeout=60, **options)


@pytest.mark.parametrize("model", MODELS)
def test_plans_are_those_of_cpn_client(planner: Planner, pictures: Tensors, model: str) -> None:
    plan = planner.reference(model, 7)
    got = infer(planner, model, pictures, parameters={"seed": 7}, request_id="first")
    actions = got.as_numpy("plan")
    assert actions is not None
    assert actions.dtype == np.float32
    np.testing.assert_array_equal(actions, np.array(plan["actions"], np.float32))
    answer = got.get_response()
    assert (answer.model_name, answer.model_version, answer.id) == (model, plan["model_digest"], "first")
    assert all(answer.parameters[f"{stage}_seconds"].double_param > 0 for stage in ("queue", "encode", "plan"))


def test_updates_versions_timeouts_and_outputs_are_options(planner: Planner, pictures: Tensors) -> None:
    plan = planner.reference("cpn", 0, 3)
    assert len(plan["inner_losses"]) == 4
    got = infer(
        planner,
        "cpn",
        pictures,
        parameters={"updates": 3},
        model_version=plan["model_digest"],
        timeout=60_000_000,
        outputs=[InferRequestedOutput("plan")],
    )
    np.testing.assert_array_equal(got.as_numpy("plan"), np.array(plan["actions"], np.float32))


def test_the_client_finds_out_what_is_served(planner: Planner) -> None:
    triton = planner.triton
    assert triton.is_server_live()
    assert triton.is_server_ready()
    assert triton.get_server_metadata().name == "planner"
    for model in MODELS:
        assert triton.is_model_ready(model)
        metadata = triton.get_model_metadata(model)
        tensors = [(tensor.name, tensor.datatype, list(tensor.shape)) for tensor in metadata.inputs]
        assert tensors == [("observation", "UINT8", [84, 84, 3]), ("goal", "UINT8", [84, 84, 3])]
        plan = planner.reference(model, 0)
        assert list(metadata.versions) == [plan["model_digest"]]
        (output,) = metadata.outputs
        assert (output.name, output.datatype) == ("plan", "FP32")
        assert list(output.shape) == [len(plan["actions"]), len(plan["first_action"])]
        config = triton.get_model_config(model).config
        assert (config.name, config.max_batch_size) == (model, 0)
    assert not triton.is_model_ready("gpt")


def test_a_wrong_request_raises_and_the_next_is_answered(planner: Planner, pictures: Tensors) -> None:
    frame = pictures["observation"]
    for tensors, options, status, error in [
        ({**pictures, "goal": frame[:42]}, {}, "INVALID_ARGUMENT", r"goal: expected UINT8 .* got UINT8 \[42, 84, 3\]"),
        ({**pictures, "goal": frame / 255}, {}, "INVALID_ARGUMENT", r"goal: expected UINT8 .* got FP64 \[84, 84, 3\]"),
        ({"goal": frame}, {}, "INVALID_ARGUMENT", "observation: expected a tensor, got none"),
        ({**pictures, "state": np.zeros(3)}, {}, "INVALID_ARGUMENT", "inputs: expected observation, .* got state"),
        (pictures, {"parameters": {"seed": "x"}}, "INVALID_ARGUMENT", "parameters.seed: expected an integer"),
        (pictures, {"priority": 1}, "INVALID_ARGUMENT", "parameters: expected seed, updates, timeout, got priority"),
        (pictures, {"model_version": "1"}, "FAILED_PRECONDITION", "model_version: expected .* got 1"),
    ]:
        with pytest.raises(InferenceServerException, match=error) as refused:
            infer(planner, "cpn", tensors, **options)
        assert refused.value.status() == f"StatusCode.{status}"
        assert infer(planner, "cpn", pictures).as_numpy("plan") is not None
    with pytest.raises(InferenceServerException, match=r"model_name: expected one of bc, .* got gpt") as refused:
        infer(planner, "gpt", pictures)
    assert refused.value.status() == "StatusCode.NOT_FOUND"


def test_the_example_gets_a_plan(planner: Planner) -> None:
    example = ["examples/plan_triton.py", "examples/goal.png", "examples/frame.png", planner.address]
    output = subprocess.run([sys.executable, *example], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "of 5 planned actions" in output
