"""Errors on the wire: the body of every answer of the edge outside 2xx."""

from pydantic import BaseModel

from shared.wire.strict_models import omitted

# The type of a problem with an omitted part of a report that the edge does not have: the client is to send all of it.
INCOMPLETE = "urn:aicvds:problem:incomplete"


class Fault(BaseModel):
    """A field of the request at fault, and its problem in words."""

    field: str
    problem: str


class Problem(BaseModel):
    """RFC 9457 ``application/problem+json``; ``errors`` names each field at fault."""

    type: str = "about:blank"
    title: str = ""
    status: int = 0
    detail: str
    errors: list[Fault] = []
    owner: str | None = omitted(
        "of a 421: the URL of the edge that has the mission; the header Location has the whole address"
    )
