"""Shows reStructuredText roles of docstrings (:func:`~a.b`) as code, which Markdown understands."""

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:func|class|mod|meth|data|attr|exc):`(~?)([^`<]*?)(?: <[^`>]*>)?`")


def plain(text: str) -> str:
    """Replace every role by its target as code, by its last part alone for ``~``."""
    return _ROLE.sub(lambda found: f"`{found[2].rpartition('.')[2] if found[1] else found[2]}`", text)


class PlainRoles(griffe.Extension):
    """Rewrites the docstring of every object as it is read."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite one docstring."""
        if obj.docstring:
            obj.docstring.value = plain(obj.docstring.value)
