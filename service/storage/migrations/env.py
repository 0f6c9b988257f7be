"""Run by alembic, on the connection that :meth:`service.storage.store.Store` gives it."""

from __future__ import annotations

from alembic import context

from service.storage.schema import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata)
with context.begin_transaction():
    context.run_migrations()
