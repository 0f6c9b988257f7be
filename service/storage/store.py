"""The store, in which missions outlive the process: SQLite in WAL mode, or PostgreSQL, by SQLAlchemy and alembic.

One edge uses a SQLite file at a time; several edges share a PostgreSQL database, where each mission has a lease
(:mod:`service.storage.leases`). A stored mission is its spec, its last checkpoint and the events since then: the
transaction that writes a checkpoint deletes the events that it covers.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from service.mission.events import Event
from service.mission.resolved_spec import ResolvedSpec
from service.storage.leases import Leases
from service.storage.locks import FileLock, StoreUnusable
from service.storage.operations import Writer
from service.storage.process_writer import ProcessWriter
from service.storage.rows import SCHEMA, Statements, checkpoints, decode, journal, missions, unpack
from service.storage.sqlite_writer import BUSY_MS, PRAGMAS
from service.storage.thread_writer import ThreadWriter
from shared.wire.schemas import MissionSpec

# Time limits of PostgreSQL: to connect; for a statement or a silent network; for an edge that is paused or disconnected
# during a transaction, which blocks its leases.
_CONNECT_S = 5
_STATEMENT_MS = 5000
_IDLE_MS = 1500
# In the midst of a pipeline a session does not count as idle. Versions before 17 have no limit of a whole transaction.
_LIMITED = "SELECT set_config(name, '3000', false) FROM pg_settings WHERE name = 'transaction_timeout'"
# An arbitrary key, which no other program of the same database may use.
_MIGRATING = 0x41494356
_SCHEMA_OF_FIRST_RELEASE = "0005"
# The address is not repeated: any part of it may be part of a password.
_NO_ADDRESS = "is no address: write %, @, :, / and ? in a password as %25, %40, %3A, %2F and %3F"


@dataclass(frozen=True, slots=True)
class StoredMission:
    """A mission in the store.

    Attributes:
        asked_for: the spec as requested.
        spec: the same with all defaults filled in.
        seq: number of the newest event.
        state: the last checkpoint, if there is one.
        events: those since the checkpoint.
    """

    asked_for: MissionSpec
    spec: ResolvedSpec
    seq: int
    state: dict[str, Any] | None
    events: list[Event]


class Store:
    """One database; its methods may be called from any thread.

    Args:
        url: path of a SQLite file, or a URL of SQLAlchemy.

    Raises:
        StoreUnusable: the store cannot be reached, is damaged or of a newer version, or another edge uses the file.

    Attributes:
        leases: of the missions in PostgreSQL; None for a SQLite file, which is exclusive to this edge.
    """

    def __init__(self, url: str) -> None:
        self.leases: Leases | None = None
        self._lock: FileLock | None = None
        try:
            self._engine = _engine(url)
            file = self._engine.url.database
            if file and self._engine.dialect.name == "sqlite":
                self._lock = FileLock(file)
                self._migrate()
                self._epoch = self._own()
            else:
                self.leases = Leases(self._engine)
                self._migrate()
        except (sa.exc.SQLAlchemyError, ImportError, OSError, RuntimeError, ValueError) as error:
            self.close()
            raise StoreUnusable(cause(error)) from None
        except StoreUnusable:
            self.close()
            raise

    def close(self) -> None:
        """Close the connections and release the lock."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None
        if hasattr(self, "_engine"):
            self._engine.dispose()

    def missions(self) -> list[str]:
        """The IDs of all missions."""
        with self._engine.connect() as db:
            return list(db.scalars(sa.select(missions.c.mission_id)))

    def has(self, mission_id: str) -> bool:
        """Whether there is such a mission."""
        with self._engine.connect() as db:
            return db.scalar(sa.select(missions.c.mission_id).where(missions.c.mission_id == mission_id)) is not None

    def load(self, mission_id: str) -> StoredMission | None:
        """A stored mission, or None; raises ``ValueError`` if it is damaged."""
        with self._engine.connect() as db:
            found = db.execute(sa.select(missions).where(missions.c.mission_id == mission_id)).first()
            if found is None:
                return None
            last = db.execute(sa.select(checkpoints).where(checkpoints.c.mission_id == mission_id)).first()
            covered = 0 if last is None else last.seq
            wanted = (journal.c.mission_id == mission_id) & (journal.c.seq > covered)
            rows = db.execute(sa.select(journal).where(wanted).order_by(journal.c.seq)).all()
        numbers = [row.seq for row in rows]
        if numbers != list(range(covered + 1, covered + 1 + len(rows))):
            raise ValueError(f"mission {mission_id}: events are missing after {covered}")
        return StoredMission(
            asked_for=MissionSpec.model_validate_json(found.asked_for),
            spec=ResolvedSpec.model_validate_json(found.spec),
            seq=covered + len(rows),
            state=None if last is None else unpack(last.state),
            events=[decode(row.kind, row.body) for row in rows],
        )

    def writer(self) -> Writer:
        """A writer of this store, outside the event loop; close it before the store."""
        statements = Statements(self._engine.dialect)
        if self.leases is not None:
            return ThreadWriter(statements, self.leases, self._engine)
        assert self._lock is not None
        return ProcessWriter(statements, self._lock.file, self._lock.descriptors, self._epoch)

    def _own(self) -> int:
        """Check the SQLite file, and raise its epoch, so that no edge that had it before can write it any more."""
        with self._engine.connect() as db:
            db.exec_driver_sql("BEGIN IMMEDIATE")
            if (fault := db.exec_driver_sql("PRAGMA quick_check(1)").scalar()) != "ok":
                raise StoreUnusable(f"the file is damaged: {fault}")
            epoch: int = db.exec_driver_sql("PRAGMA user_version").scalar_one() + 1
            db.exec_driver_sql(f"PRAGMA user_version = {epoch}")
            db.commit()
        return epoch

    def _migrate(self) -> None:
        """Bring the schema up to date. alembic is slow to import, so an up-to-date store does without it."""
        with self._engine.connect() as db:
            if self.leases is not None and db.scalar(sa.text("SHOW lock_timeout")) == "0":
                raise StoreUnusable("a pooler drops the edge's time limits: set them for its role in PostgreSQL")
            if _version(db) == SCHEMA:
                return
        from alembic import command
        from alembic.config import Config

        config = Config()
        config.set_main_option("script_location", str(Path(__file__).with_name("migrations")))
        config.set_main_option("path_separator", "os")
        with self._engine.begin() as db:
            if self.leases is not None:
                try:
                    db.execute(sa.select(sa.func.pg_advisory_xact_lock(_MIGRATING)))
                except sa.exc.OperationalError as error:
                    if "lock timeout" not in str(error):
                        raise
                    raise StoreUnusable("another edge has migrated the database for too long: end it") from None
            # Another edge may have migrated meanwhile.
            if _version(db) != SCHEMA:
                config.attributes["connection"] = db
                command.upgrade(config, "head")


def _version(db: sa.Connection) -> str | None:
    """The schema's version, None for an empty database; raises ``StoreUnusable`` if this program cannot read it."""
    known = sa.inspect(db).has_table("alembic_version")
    version: str | None = db.scalar(sa.text("SELECT version_num FROM alembic_version")) if known else None
    if version is not None and not _SCHEMA_OF_FIRST_RELEASE <= version <= SCHEMA:
        made = "by a newer version of this program" if version > SCHEMA else "before the first release"
        raise StoreUnusable(f"it was made {made} (schema {version}, not {SCHEMA})")
    return version


def _engine(url: str) -> sa.Engine:
    scheme, is_url, address = url.partition("://")
    if scheme in ("postgresql", "postgres", "postgresql+psycopg"):
        return _postgresql(f"postgresql://{address}")
    if not is_url and not url.startswith(("postgres:", "postgresql:")):
        Path(url).expanduser().parent.mkdir(parents=True, exist_ok=True)
        url = f"sqlite:///{Path(url).expanduser()}"
    try:
        parsed = sa.make_url(url)
    except (sa.exc.ArgumentError, ValueError):
        raise ValueError(_NO_ADDRESS) from None
    if parsed.get_backend_name() != "sqlite":
        raise ValueError(f"{parsed.get_backend_name()} is not known: use a SQLite file or postgresql://")
    if not parsed.database or parsed.database == ":memory:":
        raise ValueError("a SQLite store is a file; for no store at all say none")
    engine = sa.create_engine(parsed, connect_args={"timeout": BUSY_MS / 1e3})
    sa.event.listen(engine, "connect", lambda db, _: [db.execute(f"PRAGMA {pragma}") for pragma in PRAGMAS])
    return engine


def _postgresql(url: str) -> sa.Engine:
    """An engine for a URL as PostgreSQL's own programs read it: with several hosts, for example."""
    from psycopg import ProgrammingError
    from psycopg.conninfo import conninfo_to_dict

    try:
        address = conninfo_to_dict(url)
    except (ProgrammingError, UnicodeError):
        raise ValueError(_NO_ADDRESS) from None
    others = "".join(str(value) for name, value in address.items() if name not in ("user", "password"))
    if "@" in others or not str(address.get("port") or 0).replace(",", "0").isdecimal():
        raise ValueError(_NO_ADDRESS)
    limits = {
        "connect_timeout": _CONNECT_S,
        # Behind a pooler of transactions, a prepared statement of the same name may be another edge's.
        "prepare_threshold": None,
        "tcp_user_timeout": _STATEMENT_MS,
        "options": f"-c lock_timeout={BUSY_MS} -c statement_timeout={_STATEMENT_MS} "
        f"-c idle_in_transaction_session_timeout={_IDLE_MS}",
    }
    engine = sa.create_engine("postgresql+psycopg://", pool_pre_ping=True, connect_args={**limits, **address})
    sa.event.listen(engine, "connect", lambda db, _: (db.execute(_LIMITED), db.commit()))
    return engine


def cause(error: Exception) -> str:
    """An error in one line, without the SQL statement and its parameters; drivers write no password."""
    origin = getattr(error, "orig", None) or error
    return str(origin).strip().splitlines()[0] if str(origin).strip() else type(origin).__name__
