"""The text of an XML file with the positions of its elements, so that edits preserve the line numbers.

Python's ElementTree discards comments, prefixes and lines, and refuses undeclared prefixes. Drake accepts undeclared
prefixes, and its messages refer to lines.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from drake_diff.exceptions import ModelError

DEEPEST = 300  # maximum nesting depth: recursion in Python and in Drake's parser is limited


@dataclass(eq=False)
class Element:
    """An element: its tag with the prefix in the file, attributes, children, and the position of its text.

    `start`, `inside` and `end` are byte positions: of its "<", after its start tag, and after its end tag.
    """

    tag: str
    attributes: dict[str, str]
    parent: "Element | None"
    line: int
    start: int
    inside: int = 0
    end: int = 0
    text: str = ""
    children: "list[Element]" = field(default_factory=list)

    def get(self, name: str, default: str = "") -> str:
        return self.attributes.get(name, default)

    def find(self, *path: str) -> "Element | None":
        """Return the first child with the first tag, then its first child with the next tag, and so on."""
        element: Element | None = self
        for tag in path:
            element = None if element is None else next((c for c in element.children if c.tag == tag), None)
        return element

    def findall(self, *path: str) -> "list[Element]":
        """Return the children with the first tag, all their children with the next tag, and so on; "*" is any tag."""
        elements = [self]
        for tag in path:
            elements = [child for element in elements for child in element.children if tag in (child.tag, "*")]
        return elements

    def of_world(self, *tags: str) -> "list[Element]":
        """Return the elements with these tags, or all elements, in the <worldbody>s of an MJCF file's root."""
        return [element for world in self.findall("worldbody") for element in world.iter(*tags)]

    def iter(self, *tags: str) -> "Iterator[Element]":
        """Yield this element and its descendants in the order of the file, or only those with the given tags."""
        if not tags or self.tag in tags:
            yield self
        for child in self.children:
            yield from child.iter(*tags)


class XmlText:
    """An XML file's text that can be changed in place.

    Raises ModelError with the line if the text is not valid XML. The error has no cause if the text is valid but not
    supported: too deep, or with entities. `changed` means that the text differs from the file.
    """

    def __init__(self, data: bytes, *, changed: bool = False):
        self.data, self._was_changed = data, changed
        # Drake accepts comments that contain --, which XML forbids. Blanks preserve lines and positions.
        self._tags = re.sub(rb"<!--.*?-->", lambda match: re.sub(rb"[^\n]", b" ", match[0]), data, flags=re.DOTALL)
        self._changes: list[tuple[int, int, bytes]] = []
        self._open: list[Element] = []
        self._roots: list[Element] = []
        parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartElementHandler = lambda tag, attributes: self._begin(parser, tag, attributes)
        parser.EndElementHandler = lambda _: self._close(parser)
        parser.CharacterDataHandler = self._add_text
        parser.EntityDeclHandler = lambda *_: self._refuse_entity(parser)
        try:
            parser.Parse(self._tags, True)
        except expat.ExpatError as error:
            raise ModelError(f"line {error.lineno}: invalid XML: {expat.ErrorString(error.code)}") from error
        except LookupError as error:
            raise ModelError(f"line 1: {error}") from error
        self.root: Element = self._roots[0]

    def _refuse_entity(self, parser: Any) -> None:
        raise ModelError(f"line {parser.CurrentLineNumber}: XML entities are not supported, as in Drake")

    def _begin(self, parser: Any, tag: str, attributes: dict[str, str]) -> None:
        if len(self._open) >= DEEPEST:
            raise ModelError(f"line {parser.CurrentLineNumber}: expected at most {DEEPEST} levels of nested elements")
        parent = self._open[-1] if self._open else None
        start = parser.CurrentByteIndex
        element = Element(tag, attributes, parent, parser.CurrentLineNumber, start, self._behind_tag(start))
        (self._roots if parent is None else parent.children).append(element)
        self._open.append(element)

    def _close(self, parser: Any) -> None:
        element = self._open.pop()
        empty = self.data[element.inside - 2 : element.inside] == b"/>"
        element.end = element.inside if empty else self._behind_tag(parser.CurrentByteIndex)

    def _add_text(self, text: str) -> None:
        if self._open:
            self._open[-1].text += text

    def _behind_tag(self, start: int) -> int:
        """Return the position after the tag that begins at `start`, that is, after its ">" outside of quotes."""
        match = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>").match(self._tags, start)
        return match.end() if match else len(self._tags)

    def content(self, element: Element) -> str:
        """Return the XML text inside an element."""
        close = self._end_tag(element)
        return "" if close is None else self.data[element.inside : close].decode()

    def _end_tag(self, element: Element) -> int | None:
        """Return the position of an element's end tag, or None if it has no end tag."""
        if self.data[element.inside - 2 : element.inside] == b"/>":
            return None
        return self._tags.rindex(b"</", element.inside, element.end)

    def remove(self, element: Element) -> None:
        """Remove an element; its lines stay in the text as empty lines."""
        if element.parent is not None:
            element.parent.children.remove(element)
        self._replace(element.start, element.end, b"")

    def replace(self, element: Element, text: str) -> None:
        """Replace an element by XML text."""
        self._replace(element.start, element.end, text.encode())

    def before(self, element: Element, text: str) -> None:
        """Insert XML text before an element."""
        self._replace(element.start, element.start, text.encode())

    def after(self, element: Element, text: str) -> None:
        """Insert XML text after an element."""
        self._replace(element.end, element.end, text.encode())

    def append(self, element: Element, text: str) -> None:
        """Insert XML text at the end of an element's content."""
        close = self._end_tag(element)
        if close is None:
            self.fill(element, text)
        else:
            self._replace(close, close, text.encode())

    def rename(self, element: Element, tag: str) -> None:
        """Change the tag of an element."""
        close, length = self._end_tag(element), len(element.tag.encode())
        for start in (element.start + 1, *([] if close is None else [close + 2])):
            self._replace(start, start + length, tag.encode())
        element.tag = tag

    def set(self, element: Element, name: str, value: str) -> None:
        """Set the value of an attribute, or add the attribute."""
        element.attributes[name] = value
        match, new = self._attribute(element, name), quoteattr(value).encode()
        if match:
            self._replace(element.start + match.start(1), element.start + match.end(1), new)
        else:
            offset = element.start + 1 + len(element.tag.encode())
            self._replace(offset, offset, b" " + name.encode() + b"=" + new)

    def drop(self, element: Element, name: str) -> None:
        """Remove an attribute if it exists."""
        if match := self._attribute(element, name):
            self._replace(element.start + match.start(), element.start + match.end(), b"")

    def _attribute(self, element: Element, name: str) -> re.Match[bytes] | None:
        tag = self.data[element.start : element.inside]
        return re.search(rb"\s" + re.escape(name.encode()) + rb"\s*=\s*(\"[^\"]*\"|'[^']*')", tag)

    def fill(self, element: Element, content: str) -> None:
        """Replace the content of an element by XML text."""
        close = self._end_tag(element)
        if close is None:
            self._replace(element.inside - 2, element.inside, f">{content}</{element.tag}>".encode())
        else:
            self._replace(element.inside, close, content.encode())

    def _replace(self, start: int, end: int, new: bytes) -> None:
        lost = self.data.count(b"\n", start, end) - new.count(b"\n")
        self._changes.append((start, end, new + b"\n" * max(lost, 0)))

    @property
    def changed(self) -> bool:
        """Whether the text was changed."""
        return self._was_changed or bool(self._changes)

    def read_again(self) -> "XmlText":
        """Parse the changed text again, with its new positions and attributes."""
        return XmlText(str(self).encode(), changed=self.changed)

    def __str__(self) -> str:
        """Return the text with all changes; an outer change overrides the changes inside it."""
        parts, end_of_last = [], 0
        for start, end, new in sorted(self._changes, key=lambda c: (c[0], c[1] > c[0], -c[1])):  # insertions first
            if start >= end_of_last:
                parts += [self.data[end_of_last:start], new]
                end_of_last = end
        return (b"".join(parts) + self.data[end_of_last:]).decode()


def numbers_in(text: str) -> list[float]:
    """Return the numbers of an attribute, or [] if it has other text, which Drake refuses when it reads it."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def first_number(attributes: Element | dict[str, str], name: str, default: float = 0.0) -> float:
    """Return the first number of an attribute, or the default if there is no number."""
    numbers = numbers_in(attributes.get(name, ""))
    return numbers[0] if numbers else default
