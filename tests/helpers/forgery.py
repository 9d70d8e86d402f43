"""Forged run directories: any data can be changed, and all hashes and content policies are updated."""

import json
import re
from base64 import b64decode, b64encode
from collections.abc import Callable
from hashlib import sha256
from html import unescape
from io import BytesIO
from pathlib import Path
from typing import Any

from markupsafe import escape
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, Writer

APART = ("wall_clock", "files", "record_sha256")  # fields of a record that the trace does not contain
COMMAND = re.compile(r'(?<=fetch\("data:application/octet-binary;base64,)[^"]+')  # commands to the viewer
SCRIPT = re.compile(r"(<script(?![^>]*json)[^>]*>)(.+?)(</script>)", re.DOTALL)
VIEW = re.compile(r'(?<= srcdoc=")[^"]+')


def canonical(fields: dict[str, Any]) -> str:
    return json.dumps(fields, sort_keys=True, indent=2) + "\n"


def seal(folder: Path, fields: dict[str, Any], *, attach: bool = True) -> None:
    """Write `fields` as the record, with its hash and the hashes of all files; the trace contains it too."""
    if attach:
        carried = canonical({k: v for k, v in fields.items() if k not in APART}).encode()
        rewrite(folder / "trace.mcap", attachments={"record.json": carried})
    files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    files.pop("record.json")
    fields["files"] = {
        name: {"path": name, "bytes": len(data), "sha256": sha256(data).hexdigest(), "reason": None}
        for name, data in sorted(files.items())
    }
    (folder / "record.json").write_text(sealed(fields))


def sealed(fields: dict[str, Any]) -> str:
    """Return the text of a record with its own hash."""
    own = sha256(canonical({**fields, "record_sha256": ""}).encode()).hexdigest()
    return canonical({**fields, "record_sha256": own})


def edit(folder: Path, change: Callable[[dict[str, Any]], Any], *, files: bool = False) -> None:
    """Change the fields of a record, with its hash and, with `files`, the hashes of all files, but not the trace."""
    fields = json.loads((folder / "record.json").read_text())
    change(fields)
    if files:
        seal(folder, fields, attach=False)
    else:
        (folder / "record.json").write_text(sealed(fields))


def rewrite(
    path: Path,
    *,
    attachments: dict[str, bytes] | None = None,
    message: Callable[[int, Any, Any], bytes] | None = None,
    metadata: dict[str, str] | None = None,
    drop: int | None = None,
) -> None:
    """Write a trace again with changed attachments, messages or metadata, or without the message `drop`."""
    data, out = path.read_bytes(), BytesIO()
    writer = Writer(
        out, chunk_size=64 * 1024, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True
    )
    writer.start(profile="", library="drake_diff")
    for record in NonSeekingReader(BytesIO(data)).iter_metadata():
        writer.add_metadata(record.name, {**record.metadata, **(metadata or {})})
    for a in NonSeekingReader(BytesIO(data)).iter_attachments():
        content = (attachments or {}).get(a.name, a.data)
        writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, content)
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    summary = NonSeekingReader(BytesIO(data)).get_summary()
    for number, channel in sorted(summary.channels.items()):
        schema = summary.schemas[channel.schema_id]
        if schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        encoding = channel.message_encoding
        channels[number] = writer.register_channel(channel.topic, encoding, schemas[schema.id], channel.metadata)
    for i, (_, channel, m) in enumerate(NonSeekingReader(BytesIO(data)).iter_messages()):
        if i != drop:
            times = {"log_time": m.log_time, "publish_time": m.publish_time, "sequence": m.sequence}
            content = message(i, channel, m) if message else m.data
            writer.add_message(channels[channel.id], data=content, **times)
    writer.finish()
    path.write_bytes(out.getvalue())


def with_scripts(page: str, change: Callable[[str], str], policy: dict[str, str] | None = None) -> str:
    """Return the page with `change` applied to each script, including the scripts of the replay in it."""
    hashes = {} if policy is None else policy

    def changed(match: re.Match[str]) -> str:
        new = change(match[2])
        hashes[_hash(match[2])] = _hash(new)
        return match[1] + new + match[3]

    page = VIEW.sub(lambda match: str(escape(with_scripts(unescape(match[0]), change, hashes))), page)
    page = SCRIPT.sub(changed, page)
    for old, new in hashes.items():
        page = page.replace(old, new)
    return page


def _hash(script: str) -> str:
    return b64encode(sha256(script.encode()).digest()).decode()


def with_scene_of(page: str, other: str) -> str:
    """Return the page with the 3D motion of another page."""
    scripts = [match[2] for text in (other, *map(unescape, VIEW.findall(other))) for match in SCRIPT.finditer(text)]
    (scene,) = (script for script in scripts if COMMAND.search(script))
    return with_scripts(page, lambda script: scene if COMMAND.search(script) else script)


def with_commands(page: str, change: Callable[[int, bytes], bytes]) -> str:
    """Return the page with `change(number, command)` applied to each command to the viewer."""
    numbers = {command: i for i, command in enumerate(COMMAND.findall(unescape(page)))}

    def changed(match: re.Match[str]) -> str:
        return b64encode(change(numbers[match[0]], b64decode(match[0]))).decode()

    return with_scripts(page, lambda script: COMMAND.sub(changed, script))
