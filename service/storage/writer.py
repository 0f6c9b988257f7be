"""The interface of a store's writer: a process for SQLite, a thread for PostgreSQL."""

from collections.abc import Callable, Sequence
from typing import Protocol

from service.storage.operations import Change

# Called on the event loop: with None when the transaction is durable, or with the reason why it probably is not.
Done = Callable[[Exception | None], None]


class WriteFailed(Exception):
    """The transaction is not durable, as far as the writer knows.

    Attributes:
        lasting: later ones will fail too, until someone acts.
        final: they will until the edge is restarted.
    """

    def __init__(self, reason: str, lasting: bool = False, final: bool = False) -> None:
        super().__init__(reason)
        self.lasting, self.final = lasting, final


class Writer(Protocol):
    """Writes one transaction at a time; called from the event loop."""

    def write(self, changes: Sequence[Change], done: Done) -> None:
        """Begin a transaction of all the changes, in their order; the transaction before must have ended.

        Args:
            done: called once with the result, in a later iteration of the event loop.

        Raises:
            Exception: the transaction could not begin; ``done`` is not called.
        """

    def close(self) -> None:
        """End the writer; no transaction may be under way."""
