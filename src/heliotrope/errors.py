"""The exception tree of Heliotrope.

::

    HeliotropeError
    ├── InputError            a value, a file or an argument that cannot be used
    │   ├── FormatError       a file: names the file, the place in it, the value
    │   ├── TimeError         a naive or unusable time
    │   └── UnknownNameError  a heliostat, target, parameter or model not known
    └── FetchError            a download that could not be completed

Every message says what is wrong, where, the value with its unit, the limit and what to do. The
outcome of a solver (unreachable, not converged) is a value with a text, never an exception.
"""

import numbers
import re
from collections.abc import Iterable
from difflib import get_close_matches

#: Longest value that an error message quotes, in characters.
_LONGEST = 60


def shown(value: object) -> str:
    """Return a value as error messages quote it, on one line and shortened if necessary."""
    text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def kind_of(value: object) -> str:
    """Return the type of a value as errors name it: "a heliotrope Plant", "a pvlib Location"."""
    package, name = type(value).__module__.partition(".")[0], type(value).__name__
    text = name if package == "builtins" else f"{package} {name}"
    return f"{'an' if text[0].lower() in 'aeiou' else 'a'} {text}"


#: Kinds of object whose names often include the kind.
_DOUBLED = re.compile(r"\b(receiver|target|camera|cluster|sensor|heliostat|group) \1\b")


def once(text: str) -> str:
    """Return a text without repeated kinds, so that no error says "receiver receiver"."""
    return _DOUBLED.sub(r"\1", text)


class HeliotropeError(Exception):
    """Base class of all exceptions that Heliotrope raises on purpose."""


class InputError(HeliotropeError, ValueError):
    """A value, a file or an argument that cannot be used."""


def require(name: str, value: object, kind: type | tuple[type, ...], advice: str) -> None:
    """Raise an error that names the argument if its type is wrong.

    Raises
    ------
    InputError
        The message says what the argument is, and advises what to pass instead.
    """
    counted = kind in (numbers.Integral, numbers.Real) and isinstance(value, bool)
    if counted or not isinstance(value, kind):
        raise InputError(f"{name} is {kind_of(value)}, {shown(value)}; pass {advice}")


class FormatError(InputError):
    """A file that cannot be read in the format that it claims.

    Parameters
    ----------
    path
        The file.
    problem
        What is wrong, with the value and the limit, and what to do.
    where
        The place in the file ("line 12, column east"), if known.
    """

    def __init__(self, path: object, problem: str, where: str = "") -> None:
        self.path = str(path)
        self.where = where
        # A problem that already begins with its place would name it twice.
        problem = problem.removeprefix(f"{where}: ") if where else problem
        self.problem = problem
        place = f"{self.path}: {where}" if where else self.path
        super().__init__(f"{place}: {problem}")


class TimeError(InputError):
    """A time without a time zone, or outside the range of validity."""


class UnknownNameError(InputError, KeyError):
    """A name that is not in the collection in which it was looked up."""

    def __init__(self, what: str, name: str, known: Iterable[str]) -> None:
        self.name = name
        names = list(known)
        close = get_close_matches(name, names, n=3, cutoff=0.5)
        if close:
            hint = f"did you mean {', '.join(close)}?"
        elif not names:
            hint = "there are none"
        else:
            shown = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
            hint = f"known: {shown}"
        super().__init__(f"there is no {what} {name!r}; {hint}")

    def __str__(self) -> str:
        return str(self.args[0])


class FetchError(HeliotropeError):
    """A download that could not be completed; files already downloaded are kept."""
