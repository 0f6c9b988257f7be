"""The store's tables, as the newest migration leaves them."""

import sqlalchemy as sa

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
