"""Save what can be read of an MCAP file that is cut short or damaged."""

from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer

from drake_diff.exceptions import ArtifactError, InputError
from drake_diff.mcap_log import start
from drake_diff.mcap_read import ATTACHMENT, CHUNK, MAGIC, METADATA, read_bytes, records
from drake_diff.whole_file import whole_file

RECOVERED = "recovered"  # the name of the metadata record that tells of it
READERS: dict[int, Any] = {CHUNK: Chunk, ATTACHMENT: Attachment, METADATA: Metadata}


@dataclass(frozen=True)
class Recovered:
    """How much was saved, and what it stopped at ("" where the file was whole)."""

    messages: int
    attachments: int
    stopped_at: str


def recover_mcap(path: str | Path, out: str | Path) -> Recovered:
    """Copy what is before the first damage in `path` to the whole file `out`, which says so in its metadata.

    Chunks and attachments are copied only where their checksum holds; a metadata record has none of its own.
    Raises ArtifactError where `path` is no MCAP file, InputError where `out` exists.
    """
    path, out = Path(path), Path(out)
    if out.exists() or not out.parent.is_dir():
        raise InputError("OUT", got=str(out), expected="a file that does not exist, in a directory that does")
    data = read_bytes(path)
    if not data.startswith(MAGIC):
        raise ArtifactError(f"{path} is no MCAP file: it does not begin as one does")
    with whole_file(out) as file:
        copy = _Copy(start(file))
        stopped_at = ""
        try:
            for record in _parsed(data):
                copy.add(record)
        except Exception as error:  # damage makes the reader fail in many ways; all of them end the copy
            stopped_at = f"{type(error).__name__}: {error}"
        copy.writer.add_metadata(
            RECOVERED, {"from": path.name, "messages": str(copy.messages), "stopped_at": stopped_at or "the end"}
        )
        copy.writer.finish()
    return Recovered(copy.messages, copy.attachments, stopped_at)


def _parsed(data: bytes) -> Iterator[Any]:
    """Attachments, metadata, and what is in the chunks."""
    for opcode, body in records(data):
        if opcode in READERS:
            record = READERS[opcode].read(ReadDataStream(BytesIO(body)))
            yield from breakup_chunk(record, validate_crc=True) if opcode == CHUNK else [record]


class _Copy:
    """Writes the records of one file into another, schemas and channels under new numbers, each once."""

    def __init__(self, writer: Writer):
        self.writer, self.messages, self.attachments = writer, 0, 0
        self.schemas: dict[int, int] = {0: 0}
        self.channels: dict[int, int] = {}

    def add(self, record: Any) -> None:
        if isinstance(record, Message):
            self.writer.add_message(
                self.channels[record.channel_id],
                log_time=record.log_time,
                data=record.data,
                publish_time=record.publish_time,
                sequence=record.sequence,
            )
            self.messages += 1
        elif isinstance(record, Schema) and record.id not in self.schemas:
            self.schemas[record.id] = self.writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self.channels:
            self.channels[record.id] = self.writer.register_channel(
                record.topic, record.message_encoding, self.schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, Metadata):
            self.writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self.writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, record.data)
            self.attachments += 1
