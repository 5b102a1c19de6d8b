"""Griffe extension: parameters that a docstring describes together keep their own defaults.

Griffe gives each of ``split, fraction, seed`` the default and the annotation of the first.
"""

from typing import Any

import griffe


class GroupedParameters(griffe.Extension):
    """Give every described parameter the default and the annotation of the signature."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Correct the parsed docstring of one function."""
        if func.docstring is None:
            return
        sections = func.docstring.parse("numpy")
        for section in sections:
            if section.kind is not griffe.DocstringSectionKind.parameters:
                continue
            for described in section.value:
                if described.name in func.parameters:
                    own = func.parameters[described.name]
                    described.value, described.annotation = own.default, own.annotation
        # What the templates read; it would be parsed again otherwise.
        func.docstring.__dict__["parsed"] = sections
