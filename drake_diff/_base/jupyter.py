"""How a result shows in Jupyter: as its text, escaped, as names from models and files are untrusted."""

from html import escape

BETWEEN_WORDS = "white-space: pre-wrap; word-break: normal; overflow-wrap: anywhere"  # JupyterLab breaks inside them


def preformatted(text: str) -> str:
    """`text` as HTML, line by line as it is; what is too long for the page goes on in the next line."""
    return f'<pre style="{BETWEEN_WORDS}">{escape(text)}</pre>'


class ShowsItsRepr:
    """Shows in Jupyter what `repr` gives."""

    def _repr_html_(self) -> str:
        return preformatted(repr(self))
