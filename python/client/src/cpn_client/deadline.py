"""Deadline of a request, and retries within it."""

import time
from collections.abc import Callable
from typing import TypedDict

from tenacity import RetryCallState, retry_if_exception, wait_exponential, wait_random
from tenacity.retry import retry_base
from tenacity.wait import wait_base

from cpn_client.errors import LateError, PlannerError, can_be_retried

FIRST_PAUSE_SECONDS, LONGEST_PAUSE_SECONDS = 0.02, 0.5


class Deadline:
    """Point in time by which a request, with all its retries, has its answer."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._end = time.monotonic() + seconds
        self._outage: PlannerError | None = None

    def left(self) -> float:
        """Time left, in seconds.

        Raises:
            PlannerError: As `late`, if the deadline has passed.
        """
        left = self._end - time.monotonic()
        if left <= 0:
            raise self.late()
        return left

    def late(self) -> PlannerError:
        """Error of an attempt without an answer in time: the outage of the attempt before it, if there was one."""
        return self._outage or LateError(f"no answer within {1000 * self.seconds:.0f} ms")

    def may_retry(self, error: BaseException) -> bool:
        """Whether a failed attempt is followed by another."""
        if isinstance(error, PlannerError) and can_be_retried(error):
            self._outage = error
            return True
        return False

    def forbids(self, state: RetryCallState) -> bool:
        """Whether it passes during the pause before the next attempt."""
        return time.monotonic() + state.upcoming_sleep >= self._end


class Retries(TypedDict):
    """Arguments of `tenacity.Retrying` and `tenacity.AsyncRetrying`."""

    retry: retry_base
    wait: wait_base
    stop: Callable[[RetryCallState], bool]
    reraise: bool


def retries(deadline: Deadline) -> Retries:
    """Policy of retries until the deadline, with the last error raised. All requests can be repeated without effect."""
    pause = wait_exponential(FIRST_PAUSE_SECONDS, LONGEST_PAUSE_SECONDS) + wait_random(0, FIRST_PAUSE_SECONDS)
    return {"retry": retry_if_exception(deadline.may_retry), "wait": pause, "stop": deadline.forbids, "reraise": True}
