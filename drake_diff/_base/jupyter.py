"""How a result shows in Jupyter: as its text, escaped, as names from models and files are untrusted."""

from html import escape


def preformatted(text: str) -> str:
    """`text` as HTML, line by line as it is."""
    return f"<pre>{escape(text)}</pre>"


class ShowsItsRepr:
    """Shows in Jupyter what `repr` gives."""

    def _repr_html_(self) -> str:
        return preformatted(repr(self))
