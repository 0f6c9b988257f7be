"""The tables of the first release; the revisions before it were never released."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = None


def upgrade() -> None:
    """Make the tables; that of leases in PostgreSQL alone."""
    op.create_table(
        "missions",
        sa.Column("mission_id", sa.String(64), primary_key=True),
        sa.Column("asked_for", sa.Text, nullable=False),
        sa.Column("spec", sa.Text, nullable=False),
    )
    op.create_table(
        "checkpoints",
        sa.Column("mission_id", sa.String(64), primary_key=True),
        sa.Column("seq", sa.BigInteger, nullable=False),
        sa.Column("state", sa.LargeBinary, nullable=False),
    )
    op.create_table(
        "journal",
        sa.Column("mission_id", sa.String(64), primary_key=True),
        sa.Column("seq", sa.BigInteger, primary_key=True),
        sa.Column("kind", sa.String(16), nullable=False),
        sa.Column("body", sa.LargeBinary, nullable=False),
        sqlite_with_rowid=False,
    )
    if op.get_context().dialect.name == "postgresql":
        op.create_table(
            "leases",
            sa.Column("mission_id", sa.String(64), primary_key=True),
            sa.Column("owner", sa.String(36), nullable=False, index=True),
            sa.Column("address", sa.Text, nullable=False),
            sa.Column("epoch", sa.BigInteger, nullable=False),
            sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
        )
