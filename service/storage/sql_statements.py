"""The SQL that makes the store's changes, in one dialect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import sqlalchemy as sa

from service.storage.operations import Change, Checkpoint, Deleted, Entry, Made
from service.storage.schema import checkpoints, journal, missions
from service.storage.serialization import encode

# SQL for the database's driver, and the rows of its parameters.
Statement = tuple[str, list[Any]]


@dataclass(frozen=True, slots=True)
class _Compiled:
    """SQL, and the names of its parameters if the driver wants names."""

    sql: str
    names: tuple[str, ...] | None

    def row(self, *values: Any) -> Any:
        return values if self.names is None else dict(zip(self.names, values, strict=True))

    def of_one_row(self, *values: Any) -> Statement:
        return self.sql, [self.row(*values)]


class Statements:
    """SQL in one dialect. Each statement is idempotent, for a writer that does not know whether it was committed.

    The SQL is compiled once: making and running statements by SQLAlchemy is a large part of a commit's time.
    """

    def __init__(self, dialect: sa.Dialect) -> None:
        self._dialect = dialect
        # "On conflict" is not generic SQL; SQLAlchemy has imported the dialect in use already.
        insert: Any = import_module(f"sqlalchemy.dialects.{dialect.name}").insert
        put = insert(checkpoints)
        newer = {"seq": put.excluded.seq, "state": put.excluded.state}
        put = put.on_conflict_do_update(index_elements=["mission_id"], set_=newer)
        of: sa.BindParameter[str] = sa.bindparam("of")
        until: sa.BindParameter[int] = sa.bindparam("until")
        self._made = self._compiled(insert(missions).on_conflict_do_nothing(), *missions.c.keys())
        self._entry = self._compiled(insert(journal).on_conflict_do_nothing(), *journal.c.keys())
        self._checkpoint = self._compiled(put, *checkpoints.c.keys())
        covered = sa.delete(journal).where((journal.c.mission_id == of) & (journal.c.seq <= until))
        self._covered = self._compiled(covered, "of", "until")
        self._deleted = [
            self._compiled(sa.delete(table).where(table.c.mission_id == of), "of")
            for table in (missions, checkpoints, journal)
        ]

    def of(self, changes: Sequence[Change]) -> list[Statement]:
        """The statements that make the changes in their order; consecutive events share one statement."""
        statements: list[Statement] = []
        entries: list[Any] | None = None
        for change in changes:
            if not isinstance(change, Entry):
                entries = None
                statements.extend(self._of(change))
                continue
            if entries is None:
                entries = []
                statements.append((self._entry.sql, entries))
            entries.append(self._entry.row(change.mission_id, change.seq, *encode(change.event)))
        return statements

    def _of(self, change: Made | Checkpoint | Deleted) -> list[Statement]:
        match change:
            case Made(mission_id, asked_for, spec):
                return [self._made.of_one_row(mission_id, asked_for.model_dump_json(), spec.model_dump_json())]
            case Checkpoint(mission_id, seq, state):
                return [self._checkpoint.of_one_row(mission_id, seq, state), self._covered.of_one_row(mission_id, seq)]
            case Deleted(mission_id):
                return [deleted.of_one_row(mission_id) for deleted in self._deleted]

    def _compiled(self, statement: sa.UpdateBase, *names: str) -> _Compiled:
        keys = names if isinstance(statement, sa.Insert) else None
        sql = str(statement.compile(dialect=self._dialect, column_keys=keys))
        return _Compiled(sql, None if self._dialect.positional else names)
