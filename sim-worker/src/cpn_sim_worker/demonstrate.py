"""Streams expert demonstrations to the trainer."""

import multiprocessing
import queue
import signal
import sys
from collections import Counter
from dataclasses import dataclass
from multiprocessing.process import BaseProcess

import zenoh
from tqdm import tqdm

from cpn.v1 import demonstration_pb2, types_pb2
from cpn_sim_worker.expert import ExpertFailedError, solve
from cpn_sim_worker.opengl import OpenGLError
from cpn_sim_worker.options import DemonstrateConfig
from cpn_sim_worker.render import Renderer
from cpn_sim_worker.session import UnavailableError, open_session
from cpn_sim_worker.simulator import Simulator
from cpn_sim_worker.stream import EpisodeLostError, digest, is_recorded, send_episode
from cpn_sim_worker.tasks import FIRST_EVALUATION_SEED, MissingExtraError, SeedError
from cpn_sim_worker.wire import RequestError, action_to_proto, image_to_proto


@dataclass(frozen=True)
class Try:
    """Outcome of one variation."""

    task: str
    kept: bool
    """False if the expert failed."""


def demonstrate_episode(session: zenoh.Session, simulator: Simulator, task: str, seed: int, noise: float) -> None:
    """Solves a variation, with `noise` as in `solve`, and sends the episode, unless the trainer has stored it already.

    Raises:
        ExpertFailedError: If the expert does not solve the variation.
        EpisodeLostError: If steps stay missing.
        RequestError: If the trainer refuses the episode, or has stored it with another render spec.
        UnavailableError: If the trainer stays unavailable.
    """
    # Demonstrations with noise and without can be in one dataset.
    episode_id = f"{task}-{seed}" + (f"-noise-{noise:g}" if noise else "")
    simulator.load(task)
    render_spec = str(simulator.render_spec)
    if is_recorded(session, episode_id, render_spec):
        return
    steps = [
        demonstration_pb2.DemonstrationStep(
            episode_id=episode_id,
            step=number,
            frame=image_to_proto(simulator.frame(), render_spec),
            action=None if moment.action is None else action_to_proto(moment.action),
            applied_action=None if moment.applied is None else action_to_proto(moment.applied),
            state=moment.arrival.state,
            reward=moment.arrival.reward,
            success=moment.arrival.success,
        )
        for number, moment in enumerate(solve(simulator, task, seed, noise))
    ]
    episode = demonstration_pb2.RecordedEpisode(
        episode_id=episode_id,
        variation=types_pb2.Variation(task=task, seed=seed),
        steps=len(steps),
        digest=digest(steps),
        goal_position=simulator.scene.goal_position,
        control_hz=simulator.scene.control_hz,
        render_spec=render_spec,
    )
    send_episode(session, steps, episode)


def _run_tasks(
    config: DemonstrateConfig, tasks: "multiprocessing.Queue[str | None]", tries: "multiprocessing.Queue[Try]"
) -> None:
    """Main function of a worker process: all episodes of one task after the other, until the queue yields None."""
    # An interrupt from the terminal reaches every process; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        simulator = Simulator(Renderer())
        with open_session(config.zenoh) as session:
            for task in iter(tasks.get, None):
                kept, seed = 0, config.first_seed
                while kept < config.episodes:
                    if seed >= FIRST_EVALUATION_SEED:
                        sys.exit(f"{task}: no demonstration seeds are left")
                    try:
                        demonstrate_episode(session, simulator, task, seed, config.noise)
                        kept += 1
                        tries.put(Try(task, kept=True))
                    except ExpertFailedError:
                        tries.put(Try(task, kept=False))
                    seed += 1
    except (UnavailableError, RequestError, EpisodeLostError, MissingExtraError, SeedError, OpenGLError) as error:
        sys.exit(f"demonstrations stopped: {error}")


def demonstrate(config: DemonstrateConfig) -> None:
    """Streams the demonstrations of all tasks, and prints the numbers of episodes and rejected variations."""
    # Spawned, not forked: neither a GL context nor a zenoh session survives a fork.
    context = multiprocessing.get_context("spawn")
    tasks: multiprocessing.Queue[str | None] = context.Queue()
    tries: multiprocessing.Queue[Try] = context.Queue()
    processes: list[BaseProcess] = [
        context.Process(target=_run_tasks, args=(config, tasks, tries), daemon=True)
        for _ in range(min(config.processes, len(config.tasks)))
    ]

    for task in (*config.tasks, *(None for _ in processes)):
        tasks.put(task)
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
