"""Deadline of a request, and retries within it."""

import time
from collections.abc import Callable
from typing import TypedDict

from tenacity import RetryCallState, retry_if_exception, wait_exponential, wait_random
from tenacity.retry import retry_base
from tenacity.wait import wait_base

from cpn_client.errors import LateError, can_be_retried

FIRST_PAUSE_SECONDS, LONGEST_PAUSE_SECONDS = 0.02, 0.5


class Deadline:
    """Point in time by which a request, with all its retries, has its answer."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._end = time.monotonic() + seconds

    def left(self) -> float:
        """Time left, in seconds.

        Raises:
            LateError: If the deadline has passed.
        """
        left = self._end - time.monotonic()
        if left <= 0:
            raise self.late()
        return left

    def late(self) -> LateError:
        """Error of a request that was not answered in time."""
        return LateError(f"no answer within {1000 * self.seconds:.0f} ms")

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
    return {"retry": retry_if_exception(can_be_retried), "wait": pause, "stop": deadline.forbids, "reraise": True}
