"""The errors that end a command, and those of a call to an edge."""

from __future__ import annotations

from shared.wire import Problem


class UsageError(Exception):
    """What was asked for cannot be done; the text says what to ask for instead."""


class EdgeError(Exception):
    """The edge gave no usable answer."""


class EdgeUnreachable(EdgeError):
    """Every attempt failed on the way, or the edge was too busy each time; the text names the URL and the cause."""


class EdgeRefused(EdgeError):
    """The edge answered, and the answer was no.

    ``status`` is the HTTP status, ``detail`` the problem's own words, ``errors`` its fields at fault, ``type`` its
    type, ``about:blank`` where it has none of its own.
    """

    def __init__(self, url: str, problem: Problem, status: int) -> None:
        self.status = status
        self.detail = detail = problem.detail
        self.errors = problem.errors
        self.type = problem.type
        fields = "; ".join(": ".join(error.values()) for error in self.errors)
        super().__init__(f"{url} refused with {status}: {detail}" + (f" ({fields})" if fields else ""))

    def blames(self, field: str) -> bool:
        """Whether the problem's fields or detail name ``field``."""
        return field in self.detail or any(field in value for error in self.errors for value in error.values())


class EdgeProtocolError(EdgeError):
    """Something answered with success, and the answer is not what an AIC-VDS edge says."""
