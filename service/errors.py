"""Refusals of requests, which ``api/`` turns into problem documents."""

from http import HTTPStatus

from shared.wire.problem import INCOMPLETE


class Refused(Exception):
    """A request that cannot be served; nothing was recorded for it."""

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
    """The request contradicts the present state."""

    status = HTTPStatus.CONFLICT


class Incomplete(Conflict):
    """The request omits data that the edge does not have: the client is to send it in full."""

    type = INCOMPLETE


class Unavailable(Refused):
    """The edge cannot serve a valid request now, or cannot confirm it: the client is to send it again."""

    status = HTTPStatus.SERVICE_UNAVAILABLE


class Misdirected(Refused):
    """Another edge owns the mission: the client is to send the request there.

    Attributes:
        owner: that edge's URL; None if it gave none.
        retry_s: seconds until its lease ends, unless it is renewed. After that any edge may take over the mission.
    """

    status = HTTPStatus.MISDIRECTED_REQUEST

    def __init__(self, field: str, detail: str, owner: str | None, retry_s: float) -> None:
        super().__init__(field, detail)
        self.owner = owner
        self.retry_s = retry_s
