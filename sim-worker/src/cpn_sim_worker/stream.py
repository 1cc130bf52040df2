"""Demonstration stream: sends an episode until the trainer has stored it."""

import hashlib
from collections.abc import Iterable, Sequence

import numpy as np
import zenoh
from tenacity import retry, retry_if_exception, stop_after_delay, wait_exponential

from cpn.v1 import demonstration_pb2, types_pb2
from cpn_sim_worker import keys
from cpn_sim_worker.session import UnavailableError, ask
from cpn_sim_worker.wire import RequestError, decode, encoding

COMMIT_TIMEOUT_SECONDS = 5.0
TRAINER_PATIENCE_SECONDS = 120.0
"""Time after which sending fails if the trainer is unavailable or misses steps."""
LOOKUP_TIMEOUT_SECONDS = 2.0


class EpisodeLostError(Exception):
    """The trainer still misses steps after all retries."""


def digest(steps: Sequence[demonstration_pb2.DemonstrationStep]) -> str:
    """SHA-256 over the steps of an episode, in hex, as `RecordedEpisode.digest` defines it."""
    hasher = hashlib.sha256()
    for step in steps:
        hasher.update(step.frame.data)
        # A reward of -0 counts as 0, since not every encoder sends the sign.
        for values in (step.action.values, step.applied_action.values, step.state, [step.reward + 0.0]):
            hasher.update(np.array(values, "<f4").tobytes())
        hasher.update(bytes([step.success]))
    return hasher.hexdigest()


def is_recorded(session: zenoh.Session, episode_id: str, render_spec: str) -> bool:
    """Whether a running recorder has stored the episode.

    Raises:
        RequestError: If it has stored the episode with another render spec.
    """
    replies = session.get(keys.demonstration_recorded(episode_id), timeout=LOOKUP_TIMEOUT_SECONDS)
    recorded = [
        decode(demonstration_pb2.RecordedEpisode, reply.ok.payload.to_bytes())
        for reply in replies
        if reply.ok is not None
    ]
    for episode in recorded:
        if episode.render_spec != render_spec:
            code = types_pb2.ERROR_CODE_FAILED_PRECONDITION
            raise RequestError(code, "render_spec", episode.render_spec, render_spec)
    return bool(recorded)


def send_episode(
    session: zenoh.Session,
    steps: Sequence[demonstration_pb2.DemonstrationStep],
    episode: demonstration_pb2.RecordedEpisode,
) -> None:
    """Sends the steps and commits them, and again while the trainer misses some.

    A slow trainer slows down the sender; an unavailable one is waited for.

    Raises:
        EpisodeLostError: If steps stay missing.
        RequestError: If the trainer refuses the episode.
        UnavailableError: If the trainer stays unavailable.
    """

    def put(numbers: Iterable[int]) -> None:
        for number in numbers:
            session.put(
                keys.demonstration_step(episode.episode_id, number),
                steps[number].SerializeToString(),
                encoding=encoding(demonstration_pb2.DemonstrationStep),
                # Dropped under congestion instead of blocking a router: the next commit lists the missing steps.
                congestion_control=zenoh.CongestionControl.DROP,
            )

    # Exponential back-off, so that a busy trainer is not flooded with repeated steps.
    @retry(
        retry=retry_if_exception(_is_transient),
        wait=wait_exponential(multiplier=0.1, max=5),
        stop=stop_after_delay(TRAINER_PATIENCE_SECONDS),
        reraise=True,
    )
    def commit() -> None:
        key = keys.demonstration_commit(episode.episode_id)
        request = demonstration_pb2.CommitEpisodeRequest(episode=episode)
        response = ask(session, key, request, demonstration_pb2.CommitEpisodeResponse, COMMIT_TIMEOUT_SECONDS)
        if response.missing_steps:
            put(response.missing_steps)
            raise EpisodeLostError(f"{episode.episode_id}: the trainer misses {len(response.missing_steps)} steps")

    put(range(len(steps)))
    commit()


def _is_transient(error: BaseException) -> bool:
    if isinstance(error, RequestError):
        return error.code in (types_pb2.ERROR_CODE_UNAVAILABLE, types_pb2.ERROR_CODE_RESOURCE_EXHAUSTED)
    return isinstance(error, UnavailableError | EpisodeLostError)
