"""Leases of the missions, in PostgreSQL; they replace the terms of edges that had the whole store."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Make the table of leases, and drop the one of terms."""
    op.drop_table("terms")
    if op.get_context().dialect.name != "postgresql":
        return
    op.create_table(
        "leases",
        sa.Column("mission_id", sa.String(64), primary_key=True),
        sa.Column("owner", sa.String(36), nullable=False, index=True),
        sa.Column("address", sa.Text, nullable=False),
        sa.Column("epoch", sa.BigInteger, nullable=False),
        sa.Column("expires_at", sa.DateTime(timezone=True), nullable=False),
    )


def downgrade() -> None:
    """Drop the one, and make the other again."""
    if op.get_context().dialect.name == "postgresql":
        op.drop_table("leases")
    op.create_table(
        "terms",
        sa.Column("term", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("began", sa.DateTime, nullable=False, server_default=sa.func.now()),
    )
