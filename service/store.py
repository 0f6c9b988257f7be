"""Where missions outlive the process: SQLite in WAL mode, or PostgreSQL, by SQLAlchemy; the schema by alembic.

One edge uses a store at a time. A mission is its spec, its last checkpoint, and the events since: what a checkpoint
holds is deleted from the journal in the same transaction that brings it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from service.events import Event, decode, encode
from service.hold import DatabaseHold, FileHold, StoreUnusable
from service.packing import unpack
from shared.wire import MissionSpec

# The newest of service/migrations/versions.
SCHEMA = "0002"
# Milliseconds that a transaction waits for another program's lock of the file.
_BUSY_MS = 1000
# The longest that PostgreSQL is waited for: to connect, for a statement, and for a network that says nothing.
_CONNECT_S = 5
_STATEMENT_MS = 5000

metadata = sa.MetaData()
missions = sa.Table(
    "missions",
    metadata,
    sa.Column("mission_id", sa.String(64), primary_key=True),
    # As it was asked for, and in full, so that a mission is what it was whatever the settings become.
    sa.Column("asked_for", sa.Text, nullable=False),
    sa.Column("spec", sa.Text, nullable=False),
)
checkpoints = sa.Table(
    "checkpoints",
    metadata,
    sa.Column("mission_id", sa.String(64), primary_key=True),
    sa.Column("seq", sa.BigInteger, nullable=False),
    sa.Column("state", sa.LargeBinary, nullable=False),
)
journal = sa.Table(
    "journal",
    metadata,
    sa.Column("mission_id", sa.String(64), primary_key=True),
    sa.Column("seq", sa.BigInteger, primary_key=True),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("body", sa.LargeBinary, nullable=False),
    sqlite_with_rowid=False,
)
terms = sa.Table(
    "terms",
    metadata,
    sa.Column("term", sa.Integer, primary_key=True),
    sa.Column("began", sa.DateTime, nullable=False, server_default=sa.func.now()),
)


@dataclass(frozen=True, slots=True)
class Made:
    """A mission begins."""

    mission_id: str
    asked_for: MissionSpec
    spec: MissionSpec


@dataclass(frozen=True, slots=True)
class Entry:
    """The event number ``seq`` of a mission, from 1."""

    mission_id: str
    seq: int
    event: Event


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A mission's whole state after event ``seq``, packed."""

    mission_id: str
    seq: int
    state: bytes


@dataclass(frozen=True, slots=True)
class Deleted:
    """A mission is over."""

    mission_id: str


Item = Made | Entry | Checkpoint | Deleted


@dataclass(frozen=True, slots=True)
class Kept:
    """A mission as the store has it: its last checkpoint, and the events since; ``seq`` is the newest's."""

    asked_for: MissionSpec
    spec: MissionSpec
    seq: int
    state: dict[str, Any] | None
    events: list[Event]


class Store:
    """One database; its methods may be called from any thread.

    Args:
        url: a path of a SQLite file, or a URL as SQLAlchemy has them.

    Raises:
        StoreUnusable: it cannot be reached, is damaged or of a newer version, or another edge uses it.
    """

    def __init__(self, url: str) -> None:
        self._hold: FileHold | DatabaseHold | None = None
        try:
            self._engine = _engine(url)
            sqlite_file = self._engine.dialect.name == "sqlite"
            self._hold = FileHold(self._engine) if sqlite_file else DatabaseHold(self._engine, terms)
            self._migrate()
            self._hold.begin_term()
        except (sa.exc.SQLAlchemyError, ImportError, OSError, ValueError) as error:
            self.close()
            raise StoreUnusable(cause(error)) from None
        except StoreUnusable:
            self.close()
            raise
        # Each dialect has its own; SQLAlchemy has imported the one that is used.
        self._insert: Any = import_module(f"sqlalchemy.dialects.{self._engine.dialect.name}").insert
        # Made once: what SQLAlchemy does to make a statement is a good part of what a commit takes. This one is in
        # nearly every commit, and given to the driver as it is.
        names = [column.name for column in journal.columns]
        new = self._insert(journal).on_conflict_do_nothing()
        self._new_entries = str(new.compile(dialect=self._engine.dialect, column_keys=names))
        self._positional = self._engine.dialect.positional
        put = self._insert(checkpoints)
        newer = {"seq": put.excluded.seq, "state": put.excluded.state}
        self._new_checkpoint = put.on_conflict_do_update(index_elements=["mission_id"], set_=newer)
        covered = (journal.c.mission_id == sa.bindparam("of")) & (journal.c.seq <= sa.bindparam("until"))
        self._covered = sa.delete(journal).where(covered)

    def close(self) -> None:
        """Let another edge have it."""
        if self._hold is not None:
            self._hold.close()
            self._hold = None
        if hasattr(self, "_engine"):
            self._engine.dispose()

    def missions(self) -> list[str]:
        """The IDs of all missions."""
        with self._engine.connect() as db:
            return list(db.scalars(sa.select(missions.c.mission_id)))

    def load(self, mission_id: str) -> Kept | None:
        """A mission as it was last written, or None; raises ``ValueError`` where what is there cannot be read."""
        with self._engine.connect() as db:
            found = db.execute(sa.select(missions).where(missions.c.mission_id == mission_id)).first()
            if found is None:
                return None
            last = db.execute(sa.select(checkpoints).where(checkpoints.c.mission_id == mission_id)).first()
            since = 0 if last is None else last.seq
            wanted = (journal.c.mission_id == mission_id) & (journal.c.seq > since)
            rows = db.execute(sa.select(journal).where(wanted).order_by(journal.c.seq)).all()
        numbers = [row.seq for row in rows]
        if numbers != list(range(since + 1, since + 1 + len(rows))):
            raise ValueError(f"mission {mission_id}: events are missing after {since}")
        return Kept(
            asked_for=MissionSpec.model_validate_json(found.asked_for),
            spec=MissionSpec.model_validate_json(found.spec),
            seq=since + len(rows),
            state=None if last is None else unpack(last.state),
            events=[decode(row.kind, row.body) for row in rows],
        )

    def write(self, items: Sequence[Item]) -> None:
        """All of it, in order, or nothing; what is there already is left.

        Raises:
            sqlalchemy.exc.SQLAlchemyError: nothing was written.
            StoreUnusable: nor will anything be: the store is closed, or another edge's by now.
        """
        if self._hold is None:
            raise StoreUnusable("it is closed")
        entries: list[Entry] = []
        with self._hold.transaction() as db:
            for item in items:
                if isinstance(item, Entry):
                    entries.append(item)
                    continue
                self._append(db, entries)
                entries = []
                self._write(db, item)
            self._append(db, entries)

    def _append(self, db: sa.Connection, entries: list[Entry]) -> None:
        rows = [(entry.mission_id, entry.seq, *encode(entry.event)) for entry in entries]
        if rows:
            names = journal.columns.keys()
            told = rows if self._positional else [dict(zip(names, row, strict=True)) for row in rows]
            db.exec_driver_sql(self._new_entries, told)

    def _write(self, db: sa.Connection, item: Made | Checkpoint | Deleted) -> None:
        match item:
            case Made(mission_id, asked_for, spec):
                row = {
                    "mission_id": mission_id,
                    "asked_for": asked_for.model_dump_json(),
                    "spec": spec.model_dump_json(),
                }
                db.execute(self._insert(missions).on_conflict_do_nothing(), row)
            case Checkpoint(mission_id, seq, state):
                db.execute(self._new_checkpoint, {"mission_id": mission_id, "seq": seq, "state": state})
                db.execute(self._covered, {"of": mission_id, "until": seq})
            case Deleted(mission_id):
                for table in (missions, checkpoints, journal):
                    db.execute(sa.delete(table).where(table.c.mission_id == mission_id))

    def _migrate(self) -> None:
        """Bring the schema up to date; alembic, slow to import, only where it is not."""
        with self._engine.connect() as db:
            known = sa.inspect(db).has_table("alembic_version")
            version = db.scalar(sa.text("SELECT version_num FROM alembic_version")) if known else None
        if version == SCHEMA:
            return
        if version is not None and version > SCHEMA:
            raise StoreUnusable(f"it was made by a newer version of this program (schema {version}, not {SCHEMA})")
        from alembic import command
        from alembic.config import Config

        config = Config()
        config.set_main_option("script_location", str(Path(__file__).with_name("migrations")))
        config.set_main_option("path_separator", "os")
        with self._engine.begin() as db:
            config.attributes["connection"] = db
            command.upgrade(config, "head")


def _engine(url: str) -> sa.Engine:
    if "://" not in url:
        Path(url).expanduser().parent.mkdir(parents=True, exist_ok=True)
        url = f"sqlite:///{Path(url).expanduser()}"
    try:
        parsed = sa.make_url(url)
    except (sa.exc.ArgumentError, ValueError):
        # What cannot be told apart may be part of a password.
        raise ValueError("is no address: write @, : and / in a password as %40, %3A and %2F") from None
    if "@" in (parsed.host or ""):
        raise ValueError("names a host with an @: write @ in a password as %40")
    if parsed.drivername in ("postgresql", "postgres"):
        parsed = parsed.set(drivername="postgresql+psycopg")
    if parsed.get_backend_name() == "sqlite":
        if not parsed.database or parsed.database == ":memory:":
            raise ValueError("a SQLite store is a file; for no store at all say none")
        engine = sa.create_engine(parsed, connect_args={"timeout": _BUSY_MS / 1e3})
        sa.event.listen(engine, "connect", _prepare)
        return engine
    if parsed.get_backend_name() != "postgresql":
        raise ValueError(f"{parsed.get_backend_name()} is not known: use a SQLite file or postgresql://")
    limits = {
        "connect_timeout": _CONNECT_S,
        "tcp_user_timeout": _STATEMENT_MS,
        "options": f"-c lock_timeout={_BUSY_MS} -c statement_timeout={_STATEMENT_MS}",
    }
    return sa.create_engine(parsed, pool_pre_ping=True, connect_args={**limits, **parsed.query})


def _prepare(connection: Any, _: object) -> None:
    """WAL, so that readers and the writer do not wait for each other; FULL, so that power may fail after a commit."""
    for pragma in ("journal_mode=WAL", "synchronous=FULL", f"busy_timeout={_BUSY_MS}"):
        connection.execute(f"PRAGMA {pragma}")


def cause(error: Exception) -> str:
    """An error in one line, without the statement and its parameters; drivers name no password."""
    origin = getattr(error, "orig", None) or error
    return str(origin).strip().splitlines()[0] if str(origin).strip() else type(origin).__name__
