"""What an MCAP file holds, part by part and in order, so that two files can be compared."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Any

from mcap import records as kinds
from mcap.data_stream import ReadDataStream
from mcap.stream_reader import breakup_chunk
from mcap_protobuf.decoder import DecoderFactory

from drake_diff.logs.mcap_file import ATTACHMENT, CHUNK, METADATA, records

READERS: dict[int, Any] = {
    0x01: kinds.Header,
    0x03: kinds.Schema,
    0x04: kinds.Channel,
    0x05: kinds.Message,
    CHUNK: kinds.Chunk,
    ATTACHMENT: kinds.Attachment,
    0x0B: kinds.Statistics,
    METADATA: kinds.Metadata,
}
FRAMING = (0x02, 0x07, 0x08, 0x0A, 0x0D, 0x0E, 0x0F)  # footer, indexes, offsets, end: where things are in the file


@dataclass(frozen=True)
class Parts:
    """What a file holds, but for how it is cut into chunks: in order, the summary included."""

    order: list[tuple[Any, ...]]  # of the messages: topic, log time, publish time, sequence
    messages: dict[str, list[bytes]]  # by topic
    schemas: dict[str, Any]  # by topic
    others: list[tuple[Any, ...]]  # the name of a record, and its fields


def parts_of(data: bytes, skip: tuple[str, ...] = ()) -> Parts:
    """The parts of a file that can be read; without messages of the topics that begin as one of `skip`."""
    order: list[tuple[Any, ...]] = []
    messages: dict[str, list[bytes]] = {}
    others: list[tuple[Any, ...]] = []
    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    for part in _records(data):
        if isinstance(part, kinds.Message):
            topic = channels[part.channel_id].topic
            if not topic.startswith(skip):
                order.append((topic, part.log_time, part.publish_time, part.sequence))
                messages.setdefault(topic, []).append(part.data)
        elif not (skip and isinstance(part, kinds.Statistics)):
            if isinstance(part, kinds.Schema):
                schemas[part.id] = part
            elif isinstance(part, kinds.Channel):
                channels[part.id] = part
            others.append(part if isinstance(part, tuple) else _told(part))
    return Parts(order, messages, {c.topic: schemas[c.schema_id] for c in channels.values()}, others)


def _told(record: Any) -> tuple[Any, ...]:
    """Its name and fields; in how many chunks the messages are depends on how well they compress."""
    return type(record).__name__, *(v for k, v in vars(record).items() if k != "chunk_count")


def _records(data: bytes) -> Iterator[Any]:
    """Each record that says something, out of its chunk; one of an unknown kind as (its number, its bytes)."""
    for opcode, body in records(data):
        kind = READERS.get(opcode)
        if kind is not None:
            record = kind.read(ReadDataStream(BytesIO(body)))
            yield from breakup_chunk(record, validate_crc=True) if opcode == CHUNK else [record]
        elif opcode not in FRAMING:
            yield (f"record of kind {opcode}", body)


def fields_by(schema: Any) -> Callable[[bytes], dict[str, Any]]:
    """A function from a message's bytes to its fields: those of messages in it by their path, lists entry by entry."""
    decode = DecoderFactory().decoder_for("protobuf", schema)
    if decode is None:
        return lambda data: {"bytes": data.hex()}
    return lambda data: dict(_flat(decode(data)))


def _flat(message: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    for described in message.DESCRIPTOR.fields:
        name = f"{path}.{described.name}" if path else described.name
        value = getattr(message, described.name)
        repeated = described.default_value == []  # `is_repeated` came with protobuf 6
        if described.cpp_type != described.CPPTYPE_MESSAGE:
            yield from ((f"{name}[{i}]", v) for i, v in enumerate(value)) if repeated else ((name, value),)
        elif repeated:
            for i, part in enumerate(value):
                yield from _flat(part, f"{name}[{i}]")
        elif message.HasField(described.name):
            yield from _flat(value, name)
