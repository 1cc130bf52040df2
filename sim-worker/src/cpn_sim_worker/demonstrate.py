"""Streams expert demonstrations to the trainer."""

import multiprocessing
import queue
import signal
import sys
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess

import numpy as np
import zenoh
from numpy.typing import NDArray
from tenacity import retry, retry_if_exception, stop_after_delay, wait_exponential
from tqdm import tqdm

from cpn.v1 import demonstration_pb2, types_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.expert import ExpertFailedError, run_expert
from cpn_sim_worker.render import Renderer
from cpn_sim_worker.session import UnavailableError, ZenohConfig, ask, open_session
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED, TASKS, check_task
from cpn_sim_worker.wire import RequestError, action_to_proto, encoding, image_to_proto

COMMIT_TIMEOUT_SECONDS = 5.0
TRAINER_PATIENCE_SECONDS = 120.0
"""How long the trainer may be away before a demonstration gives up."""
MAX_COMMITS = 10
"""Commits of one episode after which its steps are taken to be lost for good."""


@dataclass(frozen=True)
class DemonstrateConfig:
    """Stream successful expert episodes to the trainer.

    Episodes that the trainer holds already cost one short query each, so an interrupted run is simply run again.
    """

    tasks: tuple[str, ...] = TASKS
    episodes: int = 25
    """Successful episodes per task."""
    first_seed: int = 0
    """Seed of the first try. Each failure of the expert moves on to the next seed."""
    processes: int = 1
    """Processes that share the tasks."""
    zenoh: ZenohConfig = field(default_factory=ZenohConfig)

    def __post_init__(self) -> None:
        for task in self.tasks:
            check_task(task)
        if not 0 <= self.first_seed < FIRST_EVALUATION_SEED:
            raise ValueError(f"first_seed: expected 0 to {FIRST_EVALUATION_SEED - 1}, got {self.first_seed}")
        for name in ("episodes", "processes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class Try:
    """What became of one variation."""

    task: str
    kept: bool
    """False if the expert failed."""


class EpisodeLostError(Exception):
    """The trainer kept missing steps however often they were sent."""


def _may_pass(error: BaseException) -> bool:
    if isinstance(error, RequestError):
        return error.code in (types_pb2.ERROR_CODE_UNAVAILABLE, types_pb2.ERROR_CODE_RESOURCE_EXHAUSTED)
    return isinstance(error, UnavailableError)


@retry(
    retry=retry_if_exception(_may_pass),
    wait=wait_exponential(multiplier=0.1, max=5),
    stop=stop_after_delay(TRAINER_PATIENCE_SECONDS),
    reraise=True,
)
def _commit(session: zenoh.Session, request: demonstration_pb2.CommitEpisodeRequest) -> Collection[int]:
    """The steps that the trainer misses."""
    key = keys.demonstration_commit(request.episode_id)
    response = ask(session, key, request, demonstration_pb2.CommitEpisodeResponse, COMMIT_TIMEOUT_SECONDS)
    return set(response.missing_steps)


def send_episode(session: zenoh.Session, simulator: Simulator, task: str, seed: int) -> None:
    """Solves a variation and sends it, until the trainer has kept it.

    The commit comes first: the trainer answers which steps it misses, and only for those is anything rendered. So
    the first transmission, the repetition of lost steps and the resumption of an interrupted run are one path.

    Raises:
        ExpertFailedError: If the expert does not solve the variation.
        EpisodeLostError: If steps stay missing.
        RequestError: If the trainer refuses the episode.
        UnavailableError: If the trainer stays away.
    """
    actions = run_expert(simulator, task, seed)
    request = demonstration_pb2.CommitEpisodeRequest(
        episode_id=f"{task}-{seed}",
        variation=types_pb2.Variation(task=task, seed=seed),
        steps=len(actions) + 1,
    )
    for _ in range(MAX_COMMITS):
        missing = _commit(session, request)
        if not missing:
            return
        simulator.reset(task, seed)
        for step in _replay(simulator, request.episode_id, actions, missing):
            session.put(
                keys.demonstration_step(request.episode_id, step.step),
                step.SerializeToString(),
                encoding=encoding(demonstration_pb2.DemonstrationStep),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
    raise EpisodeLostError(f"{request.episode_id}: the trainer still misses steps after {MAX_COMMITS} commits")


def _replay(
    simulator: Simulator, episode_id: str, actions: NDArray[np.float32], wanted: Collection[int]
) -> Iterator[demonstration_pb2.DemonstrationStep]:
    """Applies `actions`, [T, 4], from a fresh reset on and renders the wanted ones of the T + 1 steps."""
    for step in range(len(actions) + 1):
        action = actions[step] if step < len(actions) else None
        if step in wanted:
            yield demonstration_pb2.DemonstrationStep(
                episode_id=episode_id,
                step=step,
                frame=image_to_proto(simulator.frame()),
                action=None if action is None else action_to_proto(action),
            )
        if action is not None:
            simulator.step(action)


def _run_tasks(config: DemonstrateConfig, tasks: tuple[str, ...], tries: "multiprocessing.Queue[Try]") -> None:
    """What one process does: all episodes of some tasks."""
    # An interrupt from the terminal reaches every process; the parent's is the one to act.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    simulator = Simulator(Renderer())
    try:
        with open_session(config.zenoh) as session:
            for task in tasks:
                kept, seed = 0, config.first_seed
                while kept < config.episodes:
                    if seed >= FIRST_EVALUATION_SEED:
                        sys.exit(f"{task}: no demonstration seeds are left")
                    try:
                        send_episode(session, simulator, task, seed)
                        kept += 1
                        tries.put(Try(task, kept=True))
                    except ExpertFailedError:
                        tries.put(Try(task, kept=False))
                    seed += 1
    except (UnavailableError, RequestError, EpisodeLostError) as error:
        sys.exit(f"demonstrations stopped: {error}")


def demonstrate(config: DemonstrateConfig) -> None:
    """Streams the demonstrations of every task and prints what became of the tries."""
    # Spawned, not forked: neither a GL context nor a zenoh session survives a fork.
    context = multiprocessing.get_context("spawn")
    tries: multiprocessing.Queue[Try] = context.Queue()
    processes: list[BaseProcess] = [
        context.Process(target=_run_tasks, args=(config, config.tasks[i :: config.processes], tries), daemon=True)
        for i in range(min(config.processes, len(config.tasks)))
    ]
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit("interrupted; run the same command again to resume"))
    for process in processes:
        process.start()
    tally: Counter[Try] = Counter()
    try:
        with tqdm(total=len(config.tasks) * config.episodes, unit="episode") as progress:
            while any(process.is_alive() for process in processes) or not tries.empty():
                if any(process.exitcode for process in processes):
                    break
                try:
                    result = tries.get(timeout=0.2)
                except queue.Empty:
                    continue
                tally[result] += 1
                progress.update(result.kept)
    finally:
        failed = any(process.exitcode for process in processes)
        for process in processes:
            process.terminate()
        for task in config.tasks:
            kept, rejected = tally[Try(task, kept=True)], tally[Try(task, kept=False)]
            print(f"{task}: {kept} episodes of {kept + rejected} tries, {rejected} rejected")
    if failed:
        sys.exit("demonstrations are incomplete; run the same command again to resume")
