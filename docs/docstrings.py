"""What mkdocstrings has to be told of our docstrings: a section called Example is one of examples."""

import re
from typing import Any

import griffe


class ExampleSections(griffe.Extension):
    """Reads "Example:" as "Examples:", whose lines that begin with >>> are shown as code."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rename the section in the docstring of anything that has one."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
