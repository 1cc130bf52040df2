"""An unmodified client of openpi and a planner with the shipped checkpoints."""

import socket
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from conftest import ROOT, Planner, message
from numpy.typing import NDArray
from openpi_client.action_chunk_broker import ActionChunkBroker
from openpi_client.image_tools import resize_with_pad

from cpn.v1 import planner_pb2

Pictures = tuple[NDArray[np.uint8], NDArray[np.uint8]]
MODELS = ["bc", "cpn", "cpn-position", "random", "te-bc", "upn"]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("registered", [False, True])
def test_the_actions_are_those_of_grpc(planner: Planner, pictures: Pictures, model: str, registered: bool) -> None:
    frame, goal = pictures
    request = planner_pb2.PlanRequest(model=model, goal_image=message(goal), observation=message(frame), seed=7)
    plan = planner.grpc.Plan(request, timeout=60)
    towards = {"goal/id": plan.goal_id} if registered else {"goal/image": goal}
    got = planner.connect().infer({"model": model, "observation/image": frame, "seed": 7, **towards})
    expected = np.clip(np.array([action.values for action in plan.actions], np.float32), -1, 1)
    assert got["actions"].dtype == np.float32
    np.testing.assert_array_equal(got["actions"], expected)
    np.testing.assert_array_equal(got["actions"][0], np.float32(plan.first_action.values))
    assert (got["model_digest"], got["goal_id"]) == (plan.model_digest, plan.goal_id)
    assert got["latent_distance"] == (plan.latent_distance if plan.HasField("latent_distance") else None)
    assert 0 < got["policy_timing"]["infer_ms"] < got["server_timing"]["infer_ms"]


def test_the_metadata_tell_what_is_served(planner: Planner) -> None:
    metadata = planner.connect(api_key="of no use here").get_server_metadata()
    assert metadata["image_shape"] == [84, 84, 3]
    served = planner.grpc.ListModels(planner_pb2.ListModelsRequest(), timeout=60).models
    assert list(metadata["models"]) == [info.name for info in served] == MODELS
    for info, told in zip(served, metadata["models"].values(), strict=True):
        assert told == {
            "method": info.method,
            "digest": info.digest,
            "version": info.version,
            "horizon": info.horizon,
            "training_tasks": list(info.training_tasks),
        }


def test_a_wrong_request_raises_and_the_next_is_answered(planner: Planner, pictures: Pictures) -> None:
    frame, goal = pictures
    request = {"model": "cpn", "goal/image": goal, "observation/image": frame}
    policy = planner.connect()
    large = resize_with_pad(frame, 224, 224)
    for change, error in [
        ({"model": "gpt"}, "model: expected one of bc, cpn, cpn-position, random, te-bc, upn, got gpt"),
        ({"observation/image": large}, "observation/image.height: expected 84, got 224"),
        ({"observation/image": frame / 255}, "observation/image: expected dtype .* got dtype <f8, shape"),
        ({"goal/image": goal[..., 0]}, r"goal/image: expected dtype .* shape \[84, 84\]"),
        ({"goal/id": "7"}, "goal: expected one of .* got goal/image and goal/id"),
        ({"observation/state": np.zeros(8)}, "payload: expected fields among .* got observation/state"),
        ({"prompt": "close the drawer"}, "prompt: expected none"),
        ({"seed": -1}, "seed: expected an integer"),
    ]:
        with pytest.raises(RuntimeError, match=error):
            policy.infer({**request, **change})
        assert policy.infer({**request, "prompt": ""})["actions"].shape == (5, 4)


def test_scalars_come_in_all_forms_that_the_client_packs(planner: Planner, pictures: Pictures) -> None:
    frame, goal = pictures
    policy = planner.connect()
    request = {"observation/image": frame, "goal/image": goal}
    expected = policy.infer({**request, "model": "random", "seed": 3})["actions"]
    for seed in (np.int64(3), np.uint8(3), np.array(3), np.array(3, np.int32)):
        for model in (b"random", np.str_("random"), np.bytes_(b"random"), np.array("random")):
            got = policy.infer({**request, "model": model, "seed": seed, "prompt": None, "goal/id": None})
            np.testing.assert_array_equal(got["actions"], expected)


def test_health_is_told_as_by_openpis_server(planner: Planner) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{planner.openpi_port}/healthz", timeout=60) as answer:
        assert (answer.status, answer.read()) == (200, b"OK\n")


def test_a_request_that_is_too_large_is_told_why(planner: Planner, pictures: Pictures) -> None:
    frame, goal = pictures
    policy = planner.connect()
    with pytest.raises(RuntimeError, match=r"payload: expected at most 1048576 bytes, got \d+ bytes"):
        policy.infer({"model": "cpn", "goal/image": goal, "observation/image": np.zeros((1080, 1920, 3), np.uint8)})
    assert planner.connect().infer({"model": "cpn", "goal/image": goal, "observation/image": frame})["actions"].any()


def test_openpi_hands_out_the_actions_one_by_one(planner: Planner, pictures: Pictures) -> None:
    frame, goal = pictures
    request = {"model": "cpn", "goal/image": goal, "observation/image": frame}
    policy = planner.connect()
    actions = policy.infer(request)["actions"]
    broker = ActionChunkBroker(policy, action_horizon=5)
    for expected in [*actions, *actions]:
        np.testing.assert_array_equal(broker.infer(request)["actions"], expected)


def test_the_example_gets_a_plan(planner: Planner) -> None:
    example = ["examples/plan_openpi.py", "examples/goal.png", "examples/frame.png", str(planner.openpi_port)]
    output = subprocess.run([sys.executable, *example], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "of 5 planned actions" in output


def test_a_client_without_a_sign_of_life_is_given_up(planner: Planner) -> None:
    with socket.create_connection(("127.0.0.1", planner.openpi_port), timeout=120) as client:
        client.sendall(
            b"GET / HTTP/1.1\r\nHost: planner\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        )
        received = b""
        while more := client.recv(65536):
            received += more
    assert received.startswith(b"HTTP/1.1 101")
    assert received.endswith(b"\x89\x00"), "the last it was sent is a ping"
