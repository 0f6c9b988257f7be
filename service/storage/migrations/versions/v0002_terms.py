"""The fencing terms of the edges that have used this store."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Make the table of terms."""
    op.create_table(
        "terms",
        sa.Column("term", sa.Integer, primary_key=True, autoincrement=True),
        sa.Column("began", sa.DateTime, nullable=False, server_default=sa.func.now()),
    )


def downgrade() -> None:
    """Drop it."""
    op.drop_table("terms")
