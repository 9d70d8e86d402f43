"""Read MCAP files of protobuf channels, and write them with the same bytes for the same content.

The `mcap` package does not check the checksums of attachments, data section and summary, and unpacks chunks of any
declared size. This module checks both before it reads.
"""

import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import merge
from io import BytesIO
from operator import itemgetter
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap import records as kinds
from mcap.data_stream import ReadDataStream
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

from drake_diff._base.files import GIB, MIB, read_plain, whole_file
from drake_diff._base.sandbox import check_memory
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import ArtifactError, InputError, UnknownNameError

CHUNK_SIZE = 64 * 1024  # largest loss if a process is killed or a file is damaged
LIBRARY = "drake_diff"
MOST_UNPACKED = GIB  # limit for all chunks of a file
PACKED_AT_MOST, PACKED_APART = 100, 16 * MIB  # allowed unpacked size: 100 times the file (ours: 20 times) plus 16 MiB
MOST_MESSAGES, MOST_CHANNELS = 5_000_000, 10_000
BETWEEN_LOOKS = 10_000  # messages between memory checks: protobuf ends the process if memory is exhausted
MAGIC = b"\x89MCAP0\r\n"
FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of summary, start of its offsets, CRC of the summary
DATA_END = struct.Struct("<BQI")  # opcode, length, CRC of everything before it
RECORD = struct.Struct("<BQ")  # opcode, length
CRC = struct.Struct("<I")
FOOTER_OPCODE, CHUNK, ATTACHMENT, METADATA, DATA_END_OPCODE = 0x02, 0x06, 0x09, 0x0C, 0x0F
SCHEMA, CHANNEL, MESSAGE_OPCODE, STATISTICS = 0x03, 0x04, 0x05, 0x0B
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


@dataclass(frozen=True)
class Channel:
    """A topic: messages of one protobuf class with log times [ns], in order; units or names are metadata."""

    topic: str
    message_class: Any
    messages: Iterable[tuple[int, Any]]
    metadata: Mapping[str, Any] = field(default_factory=dict)


def write_mcap(
    path: Path, channels: Sequence[Channel], metadata: Mapping[str, str], attachments: Mapping[str, tuple[str, bytes]]
) -> None:
    """Write `channels` to `path`; `attachments` maps names to (media type, data).

    The file is written in chunks and moved to `path` when it is complete. Raises InputError if a time decreases.
    """
    with whole_file(path) as file:
        writer = Writer(
            file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True
        )
        writer.start(profile="", library=LIBRARY)
        writer.add_metadata("run", dict(metadata))
        for name, (media_type, data) in attachments.items():
            writer.add_attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        ids = []
        for channel in channels:
            descriptors: FileDescriptorSet = build_file_descriptor_set(channel.message_class)
            schema = writer.register_schema(
                name=channel.message_class.DESCRIPTOR.full_name,
                encoding="protobuf",
                data=bytes(descriptors.SerializeToString(deterministic=True)),
            )
            content = {key: json.dumps(value, sort_keys=True) for key, value in sorted(channel.metadata.items())}
            ids.append(writer.register_channel(channel.topic, "protobuf", schema, content))
        for time, rank, sequence, message in merge(*(_timed(rank, channel) for rank, channel in enumerate(channels))):
            data = message.SerializeToString(deterministic=True)
            writer.add_message(ids[rank], log_time=time, data=data, publish_time=time, sequence=sequence)
        writer.finish()


def _timed(rank: int, channel: Channel) -> Iterator[tuple[int, int, int, Any]]:
    last = 0
    for sequence, (time, message) in enumerate(channel.messages):
        if time < last:
            raise InputError(f"time of message {sequence} of {channel.topic}", got=time, expected=f"at least {last}")
        last = time
        yield time, rank, sequence, message


@dataclass(frozen=True, repr=False)
class McapLog(ShowsItsRepr):
    """The content of a file: messages by topic, the channels' metadata, metadata records and attachments."""

    messages: dict[str, list[tuple[int, Any]]]  # log time [ns], message
    channel_metadata: dict[str, dict[str, Any]]
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    message_types: dict[str, Any]

    def arrays(self, topic: str) -> dict[str, Any]:
        """Return the fields of a channel of flat messages, such as ours, bit for bit as they were written.

        By name: (n,) numbers, (n, width) numbers, a list of arrays of different widths, or a list of texts.
        """
        if topic not in self.messages:
            raise UnknownNameError("topic", got=topic, known=self.messages)
        rows = [message for _, message in self.messages[topic]]
        names = self.channel_metadata[topic].get("names", {})
        return {
            field.name: _column(field, [getattr(row, field.name) for row in rows], len(names.get(field.name, ())))
            for field in self.message_types[topic].DESCRIPTOR.fields
        }

    def __str__(self) -> str:
        count = sum(len(messages) for messages in self.messages.values())
        return f"{count} messages in {len(self.messages)} channels, {len(self.attachments)} attachments"

    def __repr__(self) -> str:
        topics = ", ".join(f"{topic} ({len(messages)})" for topic, messages in self.messages.items())
        return f"McapLog: {self}\n  {topics or 'no channels'}"


def read_mcap(path: str | Path, *, links: bool = True) -> McapLog:
    """Read all content of an MCAP file of protobuf channels, of at most 1 GiB, packed and unpacked.

    Args:
        path: The file, for example trace.mcap of a run.
        links: Whether to follow links. Use False for files in an untrusted directory.

    Returns:
        The log. Its times are in nanoseconds of simulated time, and `arrays` returns a channel's fields as arrays.

    Raises:
        ArtifactError: The file is missing, not a regular file, truncated, or unpacks to too much, a checksum (of
            chunks, data section, summary, attachments) is wrong, or a channel's schema cannot be decoded. The message
            contains the path.

    Source:
        The format: https://mcap.dev/spec

    Example:
        >>> from drake_diff.logs import read_mcap
        >>> log = read_mcap("artifacts/pendulum_swing_up/trace.mcap")
        >>> log.arrays("/state")["q"].shape[1]
        1
    """
    return parse_mcap(read_plain(Path(path), links=links), str(path))


def parse_mcap(data: bytes, name: str) -> McapLog:
    """Parse the bytes of a file with that `name`; see `read_mcap`."""
    log = McapLog({}, {}, {}, {}, {})
    try:
        _collect(data, _check_crcs(data), log)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file causes many kinds of errors in the reader
        raise ArtifactError(f"{name} is not an MCAP file of drake_diff: {type(error).__name__}: {error}") from error
    return log


def fields_of(message: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (name, value) of all numbers and texts of a protobuf message: nested messages by path, lists by index."""
    for described in message.DESCRIPTOR.fields:
        name = f"{path}.{described.name}" if path else described.name
        value, repeated = getattr(message, described.name), described.default_value == []
        if described.cpp_type != described.CPPTYPE_MESSAGE:
            yield from ((f"{name}[{i}]", v) for i, v in enumerate(value)) if repeated else ((name, value),)
        elif repeated:
            for i, inner in enumerate(value):
                yield from fields_of(inner, f"{name}[{i}]")
        elif message.HasField(described.name):
            yield from fields_of(value, name)


def records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, body) of each record of a file; the unpacked size of chunks is checked before they are unpacked.

    Raises ValueError if that size is too large, or at the end if the last record is truncated.
    """
    position, unpacked, most = len(MAGIC), 0, min(MOST_UNPACKED, PACKED_AT_MOST * len(data) + PACKED_APART)
    while position + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        position += RECORD.size + length
        body = data[position - length : position]
        if len(body) < length:
            break
        if opcode == ATTACHMENT and CRC.unpack(body[-4:])[0] != zlib.crc32(body[:-4]):
            raise ValueError("the checksum of an attachment does not match")
        if opcode == CHUNK:
            unpacked += _unpacked_size(body, most - unpacked)
        yield opcode, body
        if opcode == FOOTER_OPCODE:
            return
    raise ValueError("the file is truncated")


def _unpacked_size(body: bytes, most: int) -> int:
    """Return the declared unpacked size of a chunk; raise ValueError if it exceeds `most` or is wrong."""
    chunk = kinds.Chunk.read(ReadDataStream(BytesIO(body)))
    if chunk.uncompressed_size > most:
        raise ValueError(f"a chunk unpacks to {chunk.uncompressed_size} bytes, but at most {most} more are read")
    if chunk.compression == "zstd":
        packed = zstandard.frame_content_size(chunk.data)
        if packed not in (-1, chunk.uncompressed_size):  # -1: not declared by the frame, and no more is unpacked
            raise ValueError(f"a chunk declares {chunk.uncompressed_size} bytes, but unpacks to {packed}")
    else:
        result: Any = chunk.data
        if chunk.compression == "lz4":  # frames need not declare a size: unpack one byte more than the declared size
            result = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size + 1)
        if len(result) != chunk.uncompressed_size:
            raise ValueError(f"a chunk declares {chunk.uncompressed_size} bytes, but has {len(result)}")
    return int(chunk.uncompressed_size)


def _check_crcs(data: bytes) -> int:
    """Check the checksums of the data section and of the summary, and return the summary's start.

    Together they cover every byte except the last magic.

    The format permits files without them and the reader does not check them, but our files always have them.
    """
    if len(data) < len(MAGIC) + FOOTER.size or not data.endswith(MAGIC):
        raise ValueError("the magic bytes at the end of an MCAP file are missing: it is truncated")
    footer = len(data) - len(MAGIC) - FOOTER.size
    opcode, length, summary_start, _, summary_crc = FOOTER.unpack_from(data, footer)
    data_end = summary_start - DATA_END.size
    if (opcode, length) != (FOOTER_OPCODE, FOOTER.size - 9) or not 0 <= data_end <= footer:
        raise ValueError("the footer is damaged")
    end_opcode, end_length, data_crc = DATA_END.unpack_from(data, data_end)
    if (end_opcode, end_length) != (DATA_END_OPCODE, DATA_END.size - 9) or zlib.crc32(data[:data_end]) != data_crc:
        raise ValueError("the checksum of the data section does not match")
    if zlib.crc32(data[summary_start : len(data) - len(MAGIC) - 4]) != summary_crc:
        raise ValueError("the checksum of the summary does not match")
    return int(summary_start)


def _collect(data: bytes, summary_start: int, log: McapLog) -> None:
    """Read all content of the file in one pass, unless its own statistics exceed the limits."""
    reading = _Reading(log, _declared(data, summary_start))
    for opcode, body in _unpacked(data):
        if opcode == MESSAGE_OPCODE:
            reading.message(body)
        elif opcode in (SCHEMA, CHANNEL, ATTACHMENT, METADATA):
            reading.other(opcode, ReadDataStream(BytesIO(body)))
    for messages in log.messages.values():
        messages.sort(key=itemgetter(0))
    if reading.counted != reading.declared:
        raise ValueError(f"the file has {reading.counted} messages, but its statistics declare {reading.declared}")


class _Reading:
    """The state of reading a file, record by record."""

    def __init__(self, log: McapLog, declared: int):
        self.log, self.declared, self.counted = log, declared, 0
        self.schemas: dict[int, Any] = {}
        self.channels: dict[int, tuple[list[tuple[int, Any]], Any]] = {}  # messages of a channel, and their decoder
        self.decoders = DecoderFactory()

    def message(self, body: bytes) -> None:
        number, _, time, _ = MESSAGE.unpack_from(body)
        if self.counted >= self.declared:
            raise ValueError(f"the file has more messages than its statistics declare, {self.declared}")
        if self.counted % BETWEEN_LOOKS == 0:
            check_memory()
        self.counted += 1
        if number not in self.channels:
            raise ValueError(f"a message has the unknown channel {number}")
        messages, decode = self.channels[number]
        messages.append((time, decode(body[MESSAGE.size :])))

    def other(self, opcode: int, stream: Any) -> None:
        if opcode == SCHEMA:
            schema = kinds.Schema.read(stream)
            self.schemas[schema.id] = schema
        elif opcode == METADATA:
            metadata = kinds.Metadata.read(stream)
            self.log.metadata[metadata.name] = dict(metadata.metadata)
        elif opcode == ATTACHMENT:
            attachment = kinds.Attachment.read(stream)
            self.log.attachments[attachment.name] = bytes(attachment.data)
        else:
            channel = kinds.Channel.read(stream)
            if channel.id not in self.channels:  # the summary repeats the channels
                self.channels[channel.id] = self._begin(channel)

    def _begin(self, channel: Any) -> tuple[list[tuple[int, Any]], Any]:
        """Return the list for the messages of a channel, and the decoder of a message."""
        topic, log = channel.topic, self.log
        if len(self.channels) >= MOST_CHANNELS:
            raise ValueError(f"the file has more than {MOST_CHANNELS} channels")
        if channel.schema_id not in self.schemas:
            raise ValueError(f"channel {topic} has the unknown schema {channel.schema_id}")
        decode: Any = self.decoders.decoder_for(channel.message_encoding, self.schemas[channel.schema_id])
        if decode is None:
            raise ValueError(f"channel {topic} is encoded as {channel.message_encoding!r}, not as protobuf")
        log.message_types[topic] = type(decode(b""))
        log.channel_metadata[topic] = {key: json.loads(text) for key, text in channel.metadata.items()}
        return log.messages.setdefault(topic, []), decode


def has_channels(data: bytes, encoding: str) -> bool:
    """Return whether a file has a channel with this message encoding; False for a damaged file."""
    try:
        channels = (kinds.Channel.read(ReadDataStream(BytesIO(body))) for o, body in _unpacked(data) if o == CHANNEL)
        return any(channel.message_encoding == encoding for channel in channels)
    except Exception:  # as in `parse_mcap`, which reports the damage
        return False


def raw_messages(data: bytes, encoding: str) -> tuple[list[tuple[str, str, bytes, int]], dict[str, dict[str, str]]]:
    """Return topic, schema, bytes and log time [ns] of the messages of an `encoding`, such as "cdr", and the metadata.

    Only the checksums of chunks are checked, since other writers omit the rest. Raises ValueError for a damaged file.
    """
    names, topics, rows, metadata = dict[int, str](), dict[int, tuple[str, str]](), [], dict[str, dict[str, str]]()
    for opcode, body in _unpacked(data):
        if opcode == MESSAGE_OPCODE and (head := MESSAGE.unpack_from(body))[0] in topics:
            rows.append((*topics[head[0]], body[MESSAGE.size :], head[2]))
        elif opcode == SCHEMA:
            schema = kinds.Schema.read(ReadDataStream(BytesIO(body)))
            names[schema.id] = schema.name
        elif opcode == METADATA:
            record = kinds.Metadata.read(ReadDataStream(BytesIO(body)))
            metadata[record.name] = dict(record.metadata)
        elif opcode == CHANNEL:
            channel = kinds.Channel.read(ReadDataStream(BytesIO(body)))
            if channel.message_encoding == encoding:
                topics[channel.id] = channel.topic, names.get(channel.schema_id, "")
    return rows, metadata


def _unpacked(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield `records`, with the contents of each chunk in its place."""
    for opcode, body in records(data):
        if opcode != CHUNK:
            yield opcode, body
            continue
        stream, size = get_chunk_data_stream(kinds.Chunk.read(ReadDataStream(BytesIO(body))), validate_crc=True)
        inner, position = stream.read(size), 0
        while position < size:
            opcode, length = RECORD.unpack_from(inner, position)
            position += RECORD.size + length
            if position > size or not opcode:
                raise ValueError("a record in a chunk is truncated, or has the opcode 0")
            yield opcode, inner[position - length : position]


def _declared(data: bytes, position: int) -> int:
    """Return the number of messages in the statistics of the summary at `position`; raise ValueError if too large."""
    while position + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, position)
        position += RECORD.size + length
        if opcode == STATISTICS:
            result = kinds.Statistics.read(ReadDataStream(BytesIO(data[position - length : position])))
            most = {
                "messages": (result.message_count, MOST_MESSAGES),
                "channels": (result.channel_count, MOST_CHANNELS),
            }
            for what, (count, limit) in most.items():
                if count > limit:
                    raise ValueError(f"the statistics declare {count} {what}, but at most {limit} are read")
            return int(result.message_count)
    raise ValueError("the file has no statistics: it is truncated")


def _column(field: Any, values: list[Any], width: int) -> Any:
    repeated = field.default_value == []  # `is_repeated` was added in protobuf 6
    if field.cpp_type in (field.CPPTYPE_STRING, field.CPPTYPE_MESSAGE):
        return [list(value) if repeated else value for value in values]
    dtypes: dict[int, Any] = {field.CPPTYPE_INT64: np.int64, field.CPPTYPE_BOOL: np.bool_}
    kind = dtypes.get(field.cpp_type, np.float64)
    if not repeated:
        return np.array(values, dtype=kind)
    lists = [np.array(value, dtype=kind) for value in values]
    same = len({len(value) for value in lists}) == 1
    return np.array(lists) if same else lists or np.zeros((0, width), dtype=kind)
