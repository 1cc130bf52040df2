import json
import subprocess
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zenoh

from cpn.v1 import demonstration_pb2, types_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.options import DemonstrateConfig
from cpn_sim_worker.scene import Transition
from cpn_sim_worker.session import open_session
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.stream import digest
from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED
from cpn_sim_worker.wire import action_from_proto, decode, encoding
from tests.support import COMMAND, UNSOLVED, client, free_endpoint, pixels, router, wait_for

Step = demonstration_pb2.DemonstrationStep
ROOT = Path(__file__).resolve().parents[2]


class Trainer:
    """Trainer stub that drops every seventh step the first time."""

    def __init__(self, session: zenoh.Session) -> None:
        self.steps: defaultdict[str, dict[int, Step]] = defaultdict(dict)
        self.kept: dict[str, demonstration_pb2.RecordedEpisode] = {}
        self.received: list[tuple[str, int]] = []
        self.refuse = False
        self.seconds_per_step = 0.0
        self._subscriber = session.declare_subscriber(keys.demonstration_step("*", "*"), self._receive)
        self._queryables = [
            session.declare_queryable(keys.demonstration_commit("*"), self._commit, complete=True),
            session.declare_queryable(keys.demonstration_recorded("*"), self._recorded, complete=True),
        ]

    def _receive(self, sample: zenoh.Sample) -> None:
        time.sleep(self.seconds_per_step)
        step = decode(Step, sample.payload.to_bytes())
        assert str(sample.key_expr) == keys.demonstration_step(step.episode_id, step.step)
        first_time = (step.episode_id, step.step) not in self.received
        self.received.append((step.episode_id, step.step))
        if not (first_time and step.step % 7 == 3):
            self.steps[step.episode_id][step.step] = step

    def _commit(self, query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            episode = decode(demonstration_pb2.CommitEpisodeRequest, query.payload.to_bytes()).episode
            if self.refuse:
                error = types_pb2.Error(code=types_pb2.ERROR_CODE_INVALID_ARGUMENT, field="steps")
                query.reply_err(error.SerializeToString(), encoding=encoding(types_pb2.Error))
                return
            missing = [step for step in range(episode.steps) if step not in self.steps[episode.episode_id]]
            if not missing:
                self.kept[episode.episode_id] = episode
            response = demonstration_pb2.CommitEpisodeResponse(missing_steps=missing)
            query.reply(keys.demonstration_commit(episode.episode_id), response.SerializeToString())

    def _recorded(self, query: zenoh.Query) -> None:
        with query:
            episode_id = str(query.key_expr).split("/")[-2]
            if episode_id in self.kept:
                query.reply(keys.demonstration_recorded(episode_id), self.kept[episode_id].SerializeToString())

    def close(self) -> None:
        self._subscriber.undeclare()
        for queryable in self._queryables:
            queryable.undeclare()


@pytest.fixture
def trainer(session: zenoh.Session) -> Iterator[Trainer]:
    trainer = Trainer(session)
    yield trainer
    trainer.close()


def demonstrate(endpoint: str, *options: str) -> subprocess.CompletedProcess[str]:
    command = [COMMAND, "demonstrate", "--connect", endpoint, *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_lost_steps_are_sent_again_and_kept_episodes_are_not(
    trainer: Trainer, endpoint: str, simulator: Simulator
) -> None:
    options = ("--tasks", "reach", "coffee-button", "--episodes", "2", "--first-seed", "5", "--processes", "2")
    run = demonstrate(endpoint, *options)
    assert run.returncode == 0, run.stderr
    assert set(trainer.kept) == {"reach-5", "reach-6", "coffee-button-5", "coffee-button-6"}
    assert "reach: 2 episodes of 2 tries, 0 rejected" in run.stdout

    episode = trainer.kept["reach-5"]
    assert episode.variation == types_pb2.Variation(task="reach", seed=5)
    assert trainer.received.count(("reach-5", 3)) > 1
    steps = [trainer.steps["reach-5"][number] for number in range(episode.steps)]
    assert episode.digest == digest(steps)
    arrival = Transition(simulator.reset("reach", 5), reward=0, success=False)
    assert episode.render_spec == str(simulator.render_spec)
    for number, step in enumerate(steps):
        assert np.array_equal(pixels(step.frame), simulator.frame())
        assert step.frame.render_spec == episode.render_spec
        assert np.array_equal(step.state, arrival.state.astype(np.float32))
        assert (step.reward, step.success) == (np.float32(arrival.reward), arrival.success)
        assert step.HasField("action") == (number < episode.steps - 1)
        if step.HasField("action"):
            arrival = simulator.step(action_from_proto(step.action, 4, "action"))
    assert steps[-1].success

    trainer.received.clear()
    assert demonstrate(endpoint, *options).returncode == 0
    assert trainer.received == []


def test_demonstration_with_noise_keeps_the_experts_actions_and_the_applied_ones(
    trainer: Trainer, endpoint: str, simulator: Simulator
) -> None:
    run = demonstrate(endpoint, "--tasks", "coffee-button", "--episodes", "1", "--noise", "0.5")
    assert run.returncode == 0, run.stderr
    (episode,) = trainer.kept.values()
    assert episode.episode_id == "coffee-button-0-noise-0.5"
    steps = [trainer.steps[episode.episode_id][number] for number in range(episode.steps)]
    assert episode.digest == digest(steps)
    disturbed = [step for step in steps if step.HasField("applied_action")]
    assert disturbed
    assert all(step.applied_action.values[:3] != step.action.values[:3] for step in disturbed)
    simulator.reset("coffee-button", 0)
    for before, after in pairwise(steps):
        applied = before.applied_action if before.HasField("applied_action") else before.action
        arrival = simulator.step(action_from_proto(applied, 4, "action"))
        assert np.array_equal(after.state, arrival.state.astype(np.float32))


def test_slow_trainer_gets_everything(trainer: Trainer, endpoint: str) -> None:
    """A trainer that answers commits long before it has processed the steps."""
    trainer.seconds_per_step = 0.05
    run = demonstrate(endpoint, "--tasks", "coffee-button", "--episodes", "1")
    assert run.returncode == 0, run.stderr
    assert set(trainer.kept) == {"coffee-button-0"}


def test_episodes_survive_the_loss_of_their_router() -> None:
    endpoint = free_endpoint()
    command = [COMMAND, "demonstrate", "--mode", "client", "--connect", endpoint]
    command += ["--tasks", "coffee-button", "--episodes", "2"]
    with ExitStack() as stack:
        # There is no router yet.
        process = stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        stack.callback(process.kill)
        with open_session(router(endpoint)):
            trainer = Trainer(stack.enter_context(open_session(client(endpoint))))
            stack.callback(trainer.close)
            # The router is lost while steps are in transit.
            trainer.seconds_per_step = 0.5
            wait_for(lambda: len(trainer.received) > 2)
        received = len(trainer.received)
        assert not trainer.kept
        trainer.seconds_per_step = 0.0
        with open_session(router(endpoint)):
            output, _ = process.communicate()
            assert process.returncode == 0
    assert "coffee-button: 2 episodes of 2 tries, 0 rejected" in output
    assert set(trainer.kept) == {"coffee-button-0", "coffee-button-1"}
    assert len(trainer.received) > received


def test_digest_is_the_same_in_every_language() -> None:
    golden = json.loads((ROOT / "tests/golden/episode_digest.json").read_text())
    steps = [
        Step(
            frame=types_pb2.Image(data=bytes((7 * i + 13 * n) % 256 for i in range(84 * 84 * 3))),
            action=types_pb2.Action(values=[0.5, -0.25, n, 1.0]) if n < 2 else None,
            applied_action=types_pb2.Action(values=[-0.5, 0.25, -1.0, -1.0]) if n == 1 else None,
            state=[n + 0.5, -1.0],
            reward=n * 0.125,
            success=n == 2,
        )
        for n in range(3)
    ]
    assert digest(steps) == golden["digest"]


def test_digest_ignores_the_sign_of_a_zero_reward() -> None:
    zero, minus_zero = Step(reward=0.0), Step(reward=-0.0)
    assert zero.SerializeToString() != minus_zero.SerializeToString()
    assert digest([zero]) == digest([minus_zero]) != digest([Step(reward=0.5)])


def test_episode_recorded_with_another_render_spec_is_refused(trainer: Trainer, endpoint: str) -> None:
    trainer.kept["reach-0"] = demonstration_pb2.RecordedEpisode(episode_id="reach-0", render_spec="another")
    run = demonstrate(endpoint, "--tasks", "reach", "--episodes", "1")
    assert run.returncode == 1
    assert 'FAILED_PRECONDITION render_spec: expected another, got {"camera":"corner4",' in run.stderr
    assert trainer.received == []


def test_failed_expert_runs_are_rejected_and_counted(trainer: Trainer, endpoint: str) -> None:
    task, seed = UNSOLVED
    run = demonstrate(endpoint, "--tasks", task, "--episodes", "1", "--first-seed", str(seed))
    assert run.returncode == 0, run.stderr
    assert set(trainer.kept) == {f"{task}-{seed + 1}"}
    assert f"{task}: 1 episodes of 2 tries, 1 rejected" in run.stdout


def test_refusal_ends_the_run_with_its_reason(trainer: Trainer, endpoint: str) -> None:
    trainer.refuse = True
    run = demonstrate(endpoint, "--tasks", "reach", "--episodes", "1")
    assert run.returncode == 1
    assert "INVALID_ARGUMENT steps" in run.stderr
    assert "run the same command again" in run.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"first_seed": FIRST_EVALUATION_SEED}, "first_seed: expected 0 to 999999"),
        ({"episodes": 0}, "episodes: expected at least 1"),
        ({"processes": 0}, "processes: expected at least 1"),
        ({"tasks": ("juggle",)}, "unknown task 'juggle'"),
    ],
)
def test_invalid_configuration_is_refused(options: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DemonstrateConfig(**options)  # pyright: ignore[reportArgumentType]
