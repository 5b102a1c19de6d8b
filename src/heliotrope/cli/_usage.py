"""One line for an invalid command line: the option, its value, the limits."""

import typer
from typer.exceptions import TyperException

from heliotrope.errors import shown


def refusal(error: TyperException) -> str | None:
    """Return the line for an error; None if a group without a command only requests help."""
    context = getattr(error, "ctx", None)
    if context is not None and error.message == context.get_help():
        return None
    said = error.format_message().replace("Value error, ", "").removesuffix(".")
    text = _number(error) or " ".join(said.split())
    return text if context is None else f"{text}; see {context.command_path} -h"


def _number(error: TyperException) -> str | None:
    """Return the limits of a number in words; None for any other error.

    Each numeric option of the command line declares its limits, ``min`` and ``max``.
    """
    cause = error.__cause__
    if not isinstance(error, typer.BadParameter) or error.param is None or cause is None:
        return None
    low, high = getattr(error.param, "min", None), getattr(error.param, "max", None)
    if low is None or high is None:
        return None
    value = getattr(cause, "errors", list)()[0]["input"]
    name = error.param.opts[0] if error.param.param_type_name == "option" else error.param.name
    kind = "a whole number" if "int" in str(error.param.type_descriptor.annotation) else "a number"
    comma = " with a decimal point, without a comma" if "," in str(value) else ""
    limits = " to ".join(
        f"{end:,}" if isinstance(end, int) else f"{end:,.10g}" for end in (low, high)
    )
    about = getattr(error.param, "help", "").rstrip(".")
    return f"{name} must be {kind} from {limits}{comma}, not {shown(value)} ({about})"
