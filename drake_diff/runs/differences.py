"""Compare records, traces or pages: texts exactly, and numbers up to the rounding differences between machines.

BLAS and libm round differently on different machines. A number measured on a motion may differ by 1e-6 relative plus
1e-9. A number read from a file may differ by 1e-9 relative. The same limits apply to numbers within a text. All
differences are reported, including the allowed ones.
"""

import json
import math
import re
import struct
from base64 import b64decode
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import zip_longest
from typing import Any

from drake_diff.logs.mcap_file import McapLog, fields_of, parse_mcap
from drake_diff.pages.html import PagePieces, pieces_of

RELATIVE, ABSOLUTE = 1e-6, 1e-9
READ = (1e-9, 1e-15)  # the limits (relative, absolute) of values read from a file instead of computed along a motion
READ_SECTIONS = (
    "contract",
    "data",
    "inputs",
    "model",
    "phases",
    "problem",
)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?!\w)")  # not the digits in a hash or a name


DRAWN = ("scripts", "scene")  # the parts of a page that are compared


@dataclass(frozen=True)
class Reproduced:
    """A reproduced directory: the record's fields, and the bytes of the other files by name.

    `apart` is the relative distance of the repeated plan from the recorded one, 0 if they are bitwise equal.
    `unrepeated` states why the search was not repeated, and `missing` the keys of the record that depend on the search.
    `unchecked` are the parts of the record that could not be measured on this machine and are copied from it.
    `problems` are contradictions between the files, `undecided` reasons for an undecided verdict, and `written` the
    files that drake_diff writes. `recorded` are the fields to compare, if not all are compared.
    """

    fields: dict[str, Any]
    files: dict[str, bytes]
    apart: float = 0.0
    unrepeated: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    undecided: tuple[str, ...] = ()
    written: tuple[str, ...] = ()
    recorded: dict[str, Any] | None = None


@dataclass(frozen=True)
class Difference:
    """A value that differs from the recomputed one; `allowed` if machines may round that differently."""

    file: str
    key: str
    recorded: Any
    again: Any
    allowed: bool = False

    def __str__(self) -> str:
        return f"{self.file}: {self.key}: recorded {shown(self.recorded)}, recomputed {shown(self.again)}"


@dataclass
class FileDifferences:
    """The number of compared values in a file, and the differences."""

    file: str
    count: int = 0
    differing: list[Difference] = field(default_factory=list)

    def differ(self, key: str, recorded: Any, again: Any, *, allowed: bool = False) -> None:
        """Add a difference."""
        self.differing.append(Difference(self.file, key, recorded, again, allowed))


def shown(value: Any) -> str:
    """Format a value as a short text."""
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:.9g}"
    text = value if isinstance(value, str) else json.dumps(value, default=str, sort_keys=True)
    return text if len(text) <= 120 else f"{text[:117]}..."


def is_number(value: Any) -> bool:
    """Return whether `value` is a number; bool does not count."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def is_near(recorded: float, again: float, relative: float = RELATIVE, absolute: float = ABSOLUTE) -> bool:
    """Return whether two numbers agree up to rounding; NaN equals NaN, and infinities must be equal."""
    if not (math.isfinite(recorded) and math.isfinite(again)):
        return recorded == again or (recorded != recorded and again != again)
    return abs(recorded - again) <= relative * max(abs(recorded), abs(again)) + absolute


def is_near_text(recorded: str, again: str) -> bool:
    """Return whether two texts agree apart from numbers that agree up to rounding."""
    if NUMBER.split(recorded) != NUMBER.split(again):
        return False
    pairs = zip(NUMBER.findall(recorded), NUMBER.findall(again), strict=True)
    return all(a == b or is_near(float(a), float(b)) for a, b in pairs)


def differences(recorded: Any, again: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield (key, recorded, again) for each difference of two JSON values; list entries are matched by name, if any.

    A key that is missing in one of them is null.
    """
    if isinstance(recorded, dict) and isinstance(again, dict):
        for key in sorted(recorded.keys() | again.keys()):
            yield from differences(recorded.get(key), again.get(key), f"{path}.{key}" if path else str(key))
    elif isinstance(recorded, list) and isinstance(again, list):
        names, others = _labels(recorded), _labels(again)
        if names == others:
            for name, a, b in zip(names, recorded, again, strict=True):
                yield from differences(a, b, f"{path}[{name}]")
        elif len(names) == len(others) or all(name.isdigit() for name in (*names, *others)):
            yield path, recorded, again
        else:
            yield path, names, others
    elif type(recorded) is not type(again) or recorded != again:
        yield path, recorded, again


def _labels(entries: Sequence[Any]) -> list[str]:
    """Return the names of the entries of a list if all have distinct names, else their indices."""
    names = [entry.get("name") if isinstance(entry, dict) else None for entry in entries]
    if all(isinstance(name, str) for name in names) and len(set(names)) == len(names):
        return [str(name) for name in names]
    return [str(i) for i in range(len(entries))]


def compare_fields(compared: FileDifferences, recorded: Mapping[str, Any], again: Mapping[str, Any]) -> None:
    """Compare two JSON objects value by value."""
    compared.count += sum(1 for _ in leaves(again))
    for key, old, new in differences(dict(recorded), dict(again)):
        limits = READ if key.split(".")[0] in READ_SECTIONS else (RELATIVE, ABSOLUTE)
        near = is_number(old) and is_number(new) and is_near(old, new, *limits)
        near = near or (isinstance(old, str) and isinstance(new, str) and is_near_text(old, new))
        compared.differ(key, old, new, allowed=near)


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (path, value) for each leaf of a JSON value, including empty lists and objects."""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    if not parts or not value:
        yield path, value
    for key, piece in parts:
        yield from leaves(piece, f"{path}.{key}" if path else str(key))


def compare_bytes(compared: FileDifferences, recorded: bytes, again: bytes) -> None:
    """Compare two files byte by byte."""
    compared.count += 1
    if recorded != again:
        compared.differ("its bytes", sha256(recorded).hexdigest()[:16], sha256(again).hexdigest()[:16])


def compare_pages(compared: FileDifferences, recorded: bytes, again: bytes) -> None:
    """Compare two pages: scripts and styles exactly, numbers in the text and in drawn scenes up to rounding."""
    compared.count += 1
    if recorded == again:
        return
    old, new = (pieces_of(page.decode(errors="replace")) for page in (recorded, again))
    before = len(compared.differing)
    _compare_pieces(compared, old, new)
    if len(compared.differing) == before:
        compare_bytes(compared, recorded, again)


def _compare_pieces(compared: FileDifferences, old: PagePieces, new: PagePieces) -> None:
    if old.text != new.text:
        pairs = enumerate(zip(old.text, new.text, strict=False))
        i = next((i for i, (a, b) in pairs if a != b), min(len(old.text), len(new.text)))
        near = is_near_text(old.text, new.text)
        compared.differ(f"the text from character {i} on", old.text[i : i + 60], new.text[i : i + 60], allowed=near)
    for name in DRAWN:
        theirs, ours = getattr(old, name), getattr(new, name)
        if len(theirs) != len(ours):
            compared.differ(f"{name}, how many", len(theirs), len(ours))
            continue
        compared.count += len(ours)
        for i, (a, b) in enumerate(zip(theirs, ours, strict=True)):
            if a != b:
                near = name == "scene" and _is_near_drawing(a, b)
                hashes = (sha256(side.encode()).hexdigest()[:16] for side in (a, b))
                compared.differ(f"{name} {i} of {len(ours)}", *hashes, allowed=near)


def _is_near_drawing(recorded: str, again: str) -> bool:
    """Return whether two base64 viewer commands agree up to rounding relative to the largest number."""
    try:
        old, new = (list(_values_of(b64decode(text, validate=True))) for text in (recorded, again))
    except (ValueError, IndexError, struct.error):
        return False
    largest = max((abs(v) for v in new if isinstance(v, float) and math.isfinite(v)), default=0.0)
    return len(old) == len(new) and all(a == b or _is_near_value(a, b, largest) for a, b in zip(old, new, strict=True))


# MessagePack head byte -> the number of bytes of the length field, and of the type field after it
SIZED = {0xC4: (1, 0), 0xC5: (2, 0), 0xC6: (4, 0), 0xC7: (1, 1), 0xC8: (2, 1), 0xC9: (4, 1)}
SIZED |= {0xD9: (1, 0), 0xDA: (2, 0), 0xDB: (4, 0)}
FIXED = {0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8, 0xDC: 2, 0xDD: 4, 0xDE: 2, 0xDF: 4}
FIXED |= {0xD4 + i: 1 + 2**i for i in range(5)}
FLOATS = 0x17  # extension type of a single-precision array


def _values_of(data: bytes) -> Iterator[float | bytes]:
    """Yield the values of a MessagePack stream: floating-point numbers, and the bytes of all other values."""
    i = 0
    while i < len(data):
        head, start = data[i], i + 1
        if head in (0xCA, 0xCB):
            i = start + (4 if head == 0xCA else 8)
            yield float(struct.unpack(">f" if head == 0xCA else ">d", data[start:i])[0])
            continue
        width, more = SIZED.get(head, (0, 0))
        begin = start + width + more
        size = int.from_bytes(data[start : start + width])
        i = begin + (size if width else FIXED.get(head, head & 0x1F if 0xA0 <= head < 0xC0 else 0))
        if 0xC7 <= head <= 0xC9 and data[begin - 1] == FLOATS:
            yield data[start:begin]
            yield from struct.unpack(f"<{size // 4}f", data[begin:i])
        else:
            yield data[start - 1 : i]


def compare_traces(
    compared: FileDifferences, recorded: bytes, again: bytes, *, alike: Sequence[str] = (), skip: Sequence[str] = ()
) -> None:
    """Compare two MCAP files: attachments, metadata, schemas and channels exactly, every message field by field.

    The attachments in `alike` must exist in both files, but their content is not compared. Channels whose topics start
    with an entry of `skip` are not compared.
    """
    before = len(compared.differing)
    old, new = (parse_mcap(data, compared.file) for data in (recorded, again))
    for kind, key in (("attachment", "attachments"), ("metadata", "metadata"), ("channel", "channel_metadata")):
        theirs, ours = getattr(old, key), getattr(new, key)
        for name in sorted(theirs.keys() | ours.keys()):
            exempt = name in alike and name in theirs and name in ours
            compared.count += 1
            if theirs.get(name) != ours.get(name) and not exempt:
                compared.differ(f"{kind} {name}", repr(theirs.get(name)), repr(ours.get(name)))
    for topic in (t for t in new.messages if t in old.messages and not t.startswith(tuple(skip))):
        _compare_messages(compared, topic, old, new)
    if len(compared.differing) == before and old.attachments == new.attachments and not skip:
        compare_bytes(compared, recorded, again)  # the bytes outside the data: indexes, empty space


def _compare_messages(compared: FileDifferences, topic: str, old: McapLog, new: McapLog) -> None:
    """Compare the messages of one channel; the tolerance of a number is relative to the largest value of its field."""
    kinds = [log.message_types[topic].DESCRIPTOR.file.serialized_pb for log in (old, new)]
    if kinds[0] != kinds[1]:
        compared.differ(f"{topic} schema", repr(kinds[0]), repr(kinds[1]))
        return
    times = [[time for time, _ in log.messages[topic]] for log in (old, new)]
    if times[0] != times[1]:
        i = next((i for i, (a, b) in enumerate(zip_longest(*times)) if a != b), 0)
        compared.differ(f"{topic} message {i}, of {len(times[1])}", *(str(side[i : i + 1]) for side in times))
        return
    pairs = list(zip(old.messages[topic], new.messages[topic], strict=True))
    compared.count += len(pairs)
    largest: dict[str, float] = {}
    for key, value in (pair for _, (_, message) in pairs for pair in fields_of(message)):
        if isinstance(value, float) and math.isfinite(value):
            largest[_column(key)] = max(largest.get(_column(key), 0.0), abs(value))
    for i, ((_, item), (_, other)) in enumerate(pairs):
        theirs, ours = dict(fields_of(item)), dict(fields_of(other))
        for key in sorted(theirs.keys() | ours.keys()):
            a, b = theirs.get(key), ours.get(key)
            if not (a == b or (a != a and b != b)):
                near = _is_near_value(a, b, largest.get(_column(key), 0.0))
                compared.differ(f"{topic} {key} of message {i}", a, b, allowed=near)


def _is_near_value(recorded: Any, again: Any, largest: float) -> bool:
    """Return whether two field values agree up to rounding, relative to the `largest` value of their column."""
    if isinstance(recorded, str) and isinstance(again, str):
        return is_near_text(recorded, again)
    both = isinstance(recorded, float) and isinstance(again, float)
    return both and is_near(recorded, again, absolute=ABSOLUTE + RELATIVE * largest)


def _column(key: str) -> str:
    return re.sub(r"\[\d+\]", "", key)
