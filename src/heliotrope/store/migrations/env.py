"""Alembic runs this module, which uses the connection that `Database.migrate` passes."""

from alembic import context

from heliotrope.store.tables import metadata

connection = context.config.attributes["connection"]
# One transaction for all steps, which the caller began: SQLite's tables obey it too.
context.configure(
    connection=connection,
    target_metadata=metadata,
    transactional_ddl=True,
    render_as_batch=connection.dialect.name == "sqlite",
)
context.run_migrations()
