"""The migrations; alembic runs this on the connection that :class:`service.storage.store.Store` passes."""

from alembic import context

from service.storage.rows import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata)
with context.begin_transaction():
    context.run_migrations()
