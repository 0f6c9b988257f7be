"""The store's rows: the SQL that writes changes in one dialect, and the file format of their bytes.

Events and states are MessagePack, with numpy arrays as an extension type. Unpacking runs no code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal
from zlib import crc32

import msgpack
import numpy as np
import sqlalchemy as sa

from service.learning.trust import Advice
from service.mission.decisions import Pending
from service.mission.events import AdviserReport, Decided, Event, GuidanceChanged, ReadingsMerged, Reported, Settled
from service.mission.idempotency import Answered
from service.mission.sensor_readings import PlacedReading
from service.storage.operations import Change, Checkpoint, Deleted, Entry, Made
from shared.wire.schemas import Outcome, UavState
from shared.wire.sensor_arrays import arrays_of, columns_of

# The newest version in service/storage/migrations/versions.
SCHEMA = "0005"

metadata = sa.MetaData()
missions = sa.Table(
    "missions",
    metadata,
    sa.Column("mission_id", sa.String(64), primary_key=True),
    # The spec as requested, and with all defaults filled in: a mission stays the same when the settings change.
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
# In PostgreSQL only: the owners of missions. A row outlives its mission, so that its epoch never shrinks.
leases = sa.Table(
    "leases",
    metadata,
    sa.Column("mission_id", sa.String(64), primary_key=True),
    # One run of an edge's process.
    sa.Column("owner", sa.String(36), nullable=False, index=True),
    # Where clients reach the owner.
    sa.Column("address", sa.Text, nullable=False),
    sa.Column("epoch", sa.BigInteger, nullable=False),
    sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
)


# The first size of a packer's buffer, which grows as it must.
PACK_BYTES = 4096
# The extension type of an array.
_ARRAY = 1
# A request's outcome is a separate event; its encoding and what only the page shows is not stored. `encode` adds the
# sensors.
_REPORT = set(UavState.model_fields) - {"outcome", "base", "uplink", "sensors", "battery_percent", "height_m"}
# The fields of an outcome that change a mission's state.
_OUTCOME = set(Outcome.model_fields) - {"round_trip_ms"}

Kind = Literal["reported", "decided", "settled", "guided", "answered", "read"]
# SQL for the database's driver, and the rows of its parameters.
Statement = tuple[str, list[Any]]


@dataclass(frozen=True, slots=True)
class _Compiled:
    """SQL, and the names of its parameters if the driver wants names."""

    sql: str
    names: tuple[str, ...] | None

    def of_one_row(self, *values: Any) -> Statement:
        return self.sql, [values if self.names is None else dict(zip(self.names, values, strict=True))]


class Statements:
    """SQL in one dialect. Each statement is idempotent, for a writer that does not know whether it was committed.

    The SQL is compiled once: making and running statements by SQLAlchemy is a large part of a commit's time.
    """

    def __init__(self, dialect: sa.Dialect) -> None:
        self._dialect = dialect
        # "On conflict" is not generic SQL; SQLAlchemy has imported the dialect in use already.
        insert: Any = import_module(f"sqlalchemy.dialects.{dialect.name}").insert
        parameter: Any = sa.bindparam
        of, until, newest = parameter("of"), parameter("until"), parameter("newest")
        # Where a database has gone back, an earlier mission of the same ID is overwritten.
        self._made = self._compiled(_overwriting(insert(missions), 1), *missions.c.keys())
        self._entry = self._compiled(_overwriting(insert(journal), 2), *journal.c.keys())
        self._checkpoint = self._compiled(_overwriting(insert(checkpoints), 1), *checkpoints.c.keys())
        covered = (journal.c.mission_id == of) & ((journal.c.seq <= until) | (journal.c.seq > newest))
        self._covered = self._compiled(sa.delete(journal).where(covered), "of", "until", "newest")
        self._deleted = [
            self._compiled(sa.delete(table).where(table.c.mission_id == of), "of")
            for table in (missions, checkpoints, journal)
        ]
        if dialect.name == "postgresql":
            # A deleted mission's lease ends; its row stays, so that its epoch never shrinks.
            ended = sa.update(leases).where(leases.c.mission_id == of).values(expires_at=sa.func.clock_timestamp())
            self._deleted.append(self._compiled(ended, "of"))

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
            values = (change.mission_id, change.seq, *encode(change.event))
            names = self._entry.names
            entries.append(values if names is None else dict(zip(names, values, strict=True)))
        return statements

    def _of(self, change: Made | Checkpoint | Deleted) -> list[Statement]:
        match change:
            case Made(mission_id, asked_for, spec):
                return [self._made.of_one_row(mission_id, asked_for.model_dump_json(), spec.model_dump_json())]
            case Checkpoint(of, seq, state, _, newest):
                return [self._checkpoint.of_one_row(of, seq, state), self._covered.of_one_row(of, seq, newest)]
            case Deleted(mission_id):
                return [deleted.of_one_row(mission_id) for deleted in self._deleted]

    def _compiled(self, statement: sa.UpdateBase, *names: str) -> _Compiled:
        keys = names if isinstance(statement, sa.Insert) else None
        sql = str(statement.compile(dialect=self._dialect, column_keys=keys))
        return _Compiled(sql, None if self._dialect.positional else names)


def _overwriting(put: Any, key: int) -> Any:
    """An insert that overwrites a row of the same first ``key`` columns, the primary key."""
    names = put.table.c.keys()
    return put.on_conflict_do_update(index_elements=names[:key], set_={n: put.excluded[n] for n in names[key:]})


def encode(event: Event) -> tuple[Kind, bytes]:
    """An event's kind, and its body as bytes."""
    match event:
        case Reported(step, uav):
            body: dict[str, Any] = uav.model_dump(include=_REPORT, exclude_defaults=True)
            own = arrays_of(uav.sensors)  # packed in a quarter of the time of lists
            body["arrays"] = [own.ids, own.places.T, np.stack((own.queue, own.battery, own.gain)), own.beacon]
            return "reported", pack([step, body])
        case Decided(decision, attempt, report):
            packed = None if report is None else [report.model, report.advice._asdict()]
            return "decided", pack([decision._asdict(), attempt, packed])
        case Settled(outcome, used_for_training):
            return "settled", pack([outcome.model_dump(include=_OUTCOME), used_for_training])
        case GuidanceChanged(state):
            return "guided", pack(state)
        case Answered(key, digest, answer):
            return "answered", pack([key, digest, answer])
        case ReadingsMerged(readings):
            return "read", pack(readings)


def decode(kind: str, data: bytes) -> Event:
    """The event of a kind and a body, also of version 0.1.0; raises ``ValueError`` for damaged or unknown ones."""
    try:
        body = unpack(data)
        match kind:
            case "reported":
                if (arrays := body[1].pop("arrays", None)) is not None:
                    body[1]["sensors"] = columns_of(*arrays)
                return Reported(body[0], UavState.model_validate(body[1]))
            case "decided":
                report = None if body[2] is None else AdviserReport(body[2][0], Advice(**body[2][1]))
                return Decided(Pending.of(body[0]), body[1], report)
            case "settled":
                return Settled(Outcome.model_validate(body[0]), body[1])
            case "guided":
                return GuidanceChanged(body)
            case "answered":
                return Answered(*body)
            case "read":
                return ReadingsMerged([PlacedReading(*reading) for reading in body])
    except (AttributeError, IndexError, KeyError, TypeError) as damaged:
        raise ValueError(f"damaged event {kind}: {damaged}") from damaged
    raise ValueError(f"unknown event {kind}")


def pack(value: Any) -> bytes:
    """Bytes of nested dicts, lists, numbers, strings and arrays, and their checksum in the last four.

    Raises:
        TypeError: for anything else.
    """
    # The default buffer of 256 KB is mapped and unmapped by each call, since malloc's threshold is fixed.
    packed: bytes = msgpack.packb(value, default=_default, buf_size=PACK_BYTES)
    return packed + _checksum(packed)


def unpack(data: bytes) -> Any:
    """The value that was packed, with lists for tuples; raises ``ValueError`` for damaged bytes."""
    data, checksum = data[:-4], data[-4:]
    if checksum != _checksum(data):
        raise ValueError("damaged bytes: their checksum differs")
    try:
        return msgpack.unpackb(data, ext_hook=_array, strict_map_key=False)
    except (TypeError, msgpack.UnpackException) as damaged:
        raise ValueError(f"damaged bytes: {damaged}") from damaged


def _checksum(data: bytes) -> bytes:
    return crc32(data).to_bytes(4, "little")


def _default(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return msgpack.ExtType(
            _ARRAY, msgpack.packb((value.dtype.str, value.shape, value.tobytes()), buf_size=PACK_BYTES)
        )
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _array(code: int, data: bytes) -> Any:
    if code != _ARRAY:
        raise ValueError(f"unknown extension type {code}")
    dtype, shape, raw = msgpack.unpackb(data)
    if np.dtype(dtype).hasobject:
        raise ValueError(f"an array of {dtype} cannot be read")
    return np.frombuffer(raw, dtype=dtype).reshape(shape).copy()
