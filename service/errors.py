"""Why the edge does not do what it is asked to; ``api/`` makes problem documents of these."""

from __future__ import annotations

from http import HTTPStatus

from shared.wire.problem import INCOMPLETE


class Refused(Exception):
    """A request that cannot be served as it is; nothing was recorded for it."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY
    type = "about:blank"

    def __init__(self, field: str, detail: str) -> None:
        super().__init__(f"{field}: {detail}")
        self.field = field
        self.detail = detail


class NotFound(Refused):
    """The request names something that the edge does not know."""

    status = HTTPStatus.NOT_FOUND


class Conflict(Refused):
    """The request contradicts what is there."""

    status = HTTPStatus.CONFLICT


class Incomplete(Conflict):
    """The request leaves out what the edge does not hold: to be sent again in full."""

    type = INCOMPLETE


class Unavailable(Refused):
    """The request is right, and the edge cannot serve it now, or not for sure: to be sent again."""

    status = HTTPStatus.SERVICE_UNAVAILABLE


class Misdirected(Refused):
    """Another edge owns the mission: the request is to be sent there.

    Attributes:
        owner: that edge's URL; None where it gave none.
        retry_s: seconds until its lease ends, unless it is renewed. From then on any edge may take the mission over.
    """

    status = HTTPStatus.MISDIRECTED_REQUEST

    def __init__(self, field: str, detail: str, owner: str | None, retry_s: float) -> None:
        super().__init__(field, detail)
        self.owner = owner
        self.retry_s = retry_s
