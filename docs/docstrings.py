"""Extension of mkdocstrings that treats sections called "Example" as examples."""

import re
from typing import Any

import griffe


class ExampleSections(griffe.Extension):
    """Extension that renames "Example:" to "Examples:", so that lines that begin with >>> are shown as code."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rename the section in the docstring of an object."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
