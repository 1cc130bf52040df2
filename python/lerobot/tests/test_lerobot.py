"""Policy in an unmodified LeRobot, and a planner with the shipped checkpoints."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import torch
from conftest import FRAME, GOAL
from lerobot.envs.configs import MetaworldEnv
from lerobot.policies.factory import make_policy, make_policy_config, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_IMAGE
from torch import Tensor

import cpn_client
from cpn_client import RefusedError, Search
from lerobot_policy_cpn import CpnPolicy

DISCOVER = """
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
registries = PreTrainedConfig, EnvConfig
before = ["cpn" in registry.get_known_choices() for registry in registries]
register_third_party_plugins()
print(before, ["cpn" in registry.get_known_choices() for registry in registries])
"""
OTHER_GOAL = FRAME


def make(address: str, **settings: Any) -> PreTrainedPolicy:  # noqa: ANN401
    config = make_policy_config("cpn", address=address, **({"goal": str(GOAL)} | settings))
    return make_policy(config, env_cfg=MetaworldEnv(obs_type="pixels_agent_pos"))


def batch(*files: Path, **others: object) -> dict[str, Any]:
    """Batch as LeRobot makes it of an environment's observations."""
    frames = np.stack([np.asarray(PIL.Image.open(file).convert("RGB")) for file in files])
    return {OBS_IMAGE: torch.from_numpy(frames).permute(0, 3, 1, 2) / 255, **others}


def planned(address: str, frame: Path, **others: Any) -> Tensor:  # noqa: ANN401
    """Plan by the client alone, [1, horizon, A]."""
    with cpn_client.connect(address) as planner:
        plan = planner.plan(**{"model": "cpn", "goal": GOAL, "observation": frame} | others)
    return torch.tensor([plan.actions]).clamp(-1, 1)


def test_lerobot_discovers_the_plugin() -> None:
    found = subprocess.run([sys.executable, "-c", DISCOVER], check=True, stdout=subprocess.PIPE, text=True)
    assert found.stdout == "[False, False] [True, True]\n"


def test_action_is_that_of_the_client_through_lerobots_factories(address: str) -> None:
    policy = make(address)
    assert type(policy) is CpnPolicy
    preprocess, postprocess = make_pre_post_processors(policy.config)
    action = postprocess(policy.select_action(preprocess(batch(FRAME))))
    expected = planned(address, FRAME)
    assert torch.equal(action, expected[:, 0])
    assert (action.dtype, action.shape) == (torch.float32, (1, 4))
    assert torch.equal(policy.predict_action_chunk(batch(FRAME)), expected)


def test_updates_and_model_are_those_of_the_configuration(address: str) -> None:
    for updates in (0, 3):
        actions = make(address, updates=updates).select_action(batch(FRAME))
        assert torch.equal(actions, planned(address, FRAME, search=Search(iterations=updates))[:, 0])
    action = make(address, model="te-bc").select_action(batch(FRAME))
    assert torch.equal(action, planned(address, FRAME, model="te-bc")[:, 0])


def test_approaches_lead_beside_the_goal_where_the_hand_stalls(address: str) -> None:
    for approaches, number in ((True, 2), (False, 1)):
        policy = make(address, model="cpn-position", approaches=approaches)
        actions = torch.cat([policy.select_action(batch(FRAME)) for _ in range(10)])
        assert len(actions.unique(dim=0)) == number


def test_images_of_another_size_are_scaled_as_by_the_client(address: str, tmp_path: Path) -> None:
    large = tmp_path / "large.png"
    PIL.Image.open(FRAME).convert("RGB").resize((480, 480)).save(large)
    assert torch.equal(make(address).select_action(batch(large)), planned(address, large)[:, 0])


def test_each_environment_has_the_goal_of_its_task(address: str) -> None:
    policy = make(address, goals={"other": str(OTHER_GOAL)})
    actions = policy.select_action(batch(FRAME, GOAL, task=["other", "this"]))
    expected = planned(address, FRAME, goal=OTHER_GOAL), planned(address, GOAL)
    assert torch.equal(actions, torch.cat(expected)[:, 0])
    with pytest.raises(ValueError, match=f"{OBS_IMAGE}: expected a batch of 2, as since the last reset, got one of 1"):
        policy.select_action(batch(FRAME))
    policy.reset()
    with pytest.raises(ValueError, match="goals: expected an image file for 'this', got those for other"):
        make(address, goal="", goals={"other": str(OTHER_GOAL)}).select_action(batch(FRAME, task=["this"]))


def test_seed_counts_the_steps_of_an_episode(address: str) -> None:
    policy = make(address, model="random", seed=5)
    for seed in (5, 6):
        assert torch.equal(policy.select_action(batch(FRAME)), planned(address, FRAME, model="random", seed=seed)[:, 0])
    policy.reset()
    assert torch.equal(policy.select_action(batch(FRAME)), planned(address, FRAME, model="random", seed=5)[:, 0])


def test_saved_policy_is_loaded_again(address: str, tmp_path: Path) -> None:
    policy = make(address, updates=2)
    policy.save_pretrained(tmp_path)
    preprocess, postprocess = make_pre_post_processors(policy.config)
    preprocess.save_pretrained(tmp_path)
    postprocess.save_pretrained(tmp_path)
    loaded = CpnPolicy.from_pretrained(tmp_path)
    assert loaded.config == policy.config
    preprocess, postprocess = make_pre_post_processors(loaded.config, str(tmp_path))
    action = postprocess(loaded.select_action(preprocess(batch(FRAME))))
    assert torch.equal(action, policy.select_action(batch(FRAME)))


def test_there_is_nothing_to_train(address: str) -> None:
    policy = make(address)
    assert not list(policy.parameters())
    with pytest.raises(NotImplementedError, match="trained by cpn-trainer"):
        policy.forward({})
    with pytest.raises(NotImplementedError, match="trained by cpn-trainer"):
        policy.get_optim_params()
    with pytest.raises(NotImplementedError, match="trained by cpn-trainer"):
        policy.config.get_optimizer_preset()


def test_faulty_configuration_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match=r"goal: expected an image file .* observation.images.goal among the observ"):
        make(address, goal="")
    with pytest.raises(FileNotFoundError, match=r"missing\.png"):
        make(address, goal="missing.png")
    with pytest.raises(ValueError, match=r"image_key: expected one of observation.image, got observation.images.top"):
        make(address, image_key="observation.images.top")
    with pytest.raises(ValueError, match=r"address: expected a zenoh endpoint"):
        make("somewhere")
    with pytest.raises(RefusedError, match="NOT_FOUND model"):
        make(address, model="nobody").select_action(batch(FRAME))


@pytest.mark.slow
def test_lerobot_evaluates_the_planner(address: str, tmp_path: Path) -> None:
    goal = tmp_path / "goal.png"
    make_goal(goal)
    command = [str(Path(sys.executable).with_name("lerobot-eval")), "--policy.type=cpn", f"--policy.address={address}"]
    command += [f"--policy.goal={goal}", "--env.type=metaworld", "--env.task=plate-slide-v3"]
    command += ["--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path}"]
    subprocess.run(command, check=True)
    info = json.loads((tmp_path / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 1
    assert len(info["overall"]["video_paths"]) == 1


def make_goal(file: Path) -> None:
    """Writes the last frame of LeRobot's scripted expert."""
    from lerobot.envs.metaworld import MetaworldEnv

    env = MetaworldEnv("plate-slide-v3")
    env.reset(seed=0)
    for _ in range(150):
        state = env._env._get_obs()
        action = np.clip(env.expert_policy.get_action(state), -1, 1)
        if env._env.step(action)[-1]["success"]:
            break
    PIL.Image.fromarray(env.render().copy()).save(file)
