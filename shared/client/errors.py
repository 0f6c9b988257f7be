"""The errors of a call to an edge."""

from shared.wire.problem import Problem


class EdgeError(Exception):
    """A call to the edge yielded no usable answer."""


class InvalidEdgeUrl(EdgeError, ValueError):
    """The text is no edge's URL; it says how to write one."""


class EdgeUnreachable(EdgeError):
    """Every attempt failed in transport, or the edge was overloaded each time; the text names the URL and the cause."""


class EdgeRefused(EdgeError):
    """The edge answered with an error.

    ``status`` is the HTTP status. ``detail``, ``errors`` (the invalid fields) and ``type`` (``about:blank`` by default)
    are those of the problem document.
    """

    def __init__(self, url: str, problem: Problem, status: int) -> None:
        self.status = status
        self.detail = detail = problem.detail
        self.errors = problem.errors
        self.type = problem.type
        fields = "; ".join(f"{error.field}: {error.problem}" for error in self.errors if error.problem not in detail)
        super().__init__(f"{url} refused with {status}: {detail}" + (f" ({fields})" if fields else ""))

    def concerns(self, field: str) -> bool:
        """Whether the problem's fields or detail name ``field``."""
        return field in self.detail or any(field in error.field or field in error.problem for error in self.errors)

    @property
    def mission_unknown(self) -> bool:
        """Whether the edge does not have the request's mission."""
        return self.status == 404 and self.concerns("mission_id")


class EdgeProtocolError(EdgeError):
    """A server answered with success, but the answer does not follow the edge's protocol."""
