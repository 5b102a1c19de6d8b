"""Packages that a plain installation omits, and the extras that contain them."""

from heliotrope.errors import InputError

#: Imported name, and the extra of `pyproject.toml` that contains it.
EXTRAS = {
    "aiomqtt": "control", "alembic": "store", "argon2": "console", "cryptography": "control",
    "dask": "cluster", "distributed": "cluster", "duckdb": "store", "embreex": "rays",
    "fastapi": "console", "plotly": "notebook", "psycopg": "postgresql", "pyotp": "console",
    "segno": "console", "serialx": "control", "sqlalchemy": "store", "starlette": "console",
    "uvicorn": "console", "websockets": "console",
}  # fmt: skip
#: The extra with everything that a command needs, if that is more than one package.
_WHOLE = {"run": "console", "ctl": "console", "store": "store"}


def missing(error: ModuleNotFoundError, command: str) -> InputError | None:
    """Return the refusal for a missing package; None if no extra contains the package.

    Parameters
    ----------
    error
        Error that the import raised.
    command
        Name of the command; empty if unknown.
    """
    package = (error.name or "").partition(".")[0]
    extra = EXTRAS.get(package)
    if extra is None:
        return None
    extra = extra if extra == "postgresql" else _WHOLE.get(command, extra)
    where = f"{command}: " if command else ""
    return InputError(f"{where}{package} is not installed; run pip install 'heliotrope[{extra}]'")
