"""Errors of requests to a planner."""

EXHAUSTED, UNAVAILABLE = "RESOURCE_EXHAUSTED", "UNAVAILABLE"


class PlannerError(Exception):
    """Request without a plan."""


class UnavailableError(PlannerError):
    """No answer; a repetition of the request may get one."""


class UnreachableError(UnavailableError):
    """No connection to the address."""


class NoPlannerError(UnavailableError):
    """Connection to a network or server without the planner."""


class LateError(UnavailableError):
    """No answer within the deadline."""


class RefusedError(PlannerError):
    """Refusal by the planner, `cpn.v1.Error`."""

    def __init__(self, code: str, field: str, expected: str, got: str) -> None:
        refused = f"{code} {field}" if field else code
        super().__init__(f"{refused}: expected {expected}, got {got}")
        self.code = code
        """Name of the gRPC status, for example `INVALID_ARGUMENT`."""
        self.field = field
        """Path of the field at fault, for example `observation.height`; empty if none is."""
        self.expected = expected
        self.got = got


def is_outage(error: PlannerError) -> bool:
    """Whether the planner is away, late or too busy to keep the deadline."""
    return isinstance(error, UnavailableError) or (
        isinstance(error, RefusedError) and error.code in (EXHAUSTED, UNAVAILABLE)
    )


def can_be_retried(error: PlannerError) -> bool:
    """Whether the same request may be answered within its deadline: not after that, nor if its search is too long."""
    return is_outage(error) and not isinstance(error, LateError) and getattr(error, "field", "") != "search"


def invalid(field: str, expected: object, got: object) -> ValueError:
    """Error of an argument."""
    return ValueError(f"{field}: expected {expected}, got {got}")
