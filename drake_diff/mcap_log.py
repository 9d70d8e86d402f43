"""An MCAP file of protobuf channels: written whole, byte for byte the same for the same content, read with its CRCs."""

import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

from drake_diff.exceptions import ArtifactError
from drake_diff.whole_file import write_whole

CHUNK_SIZE = 64 * 1024  # what a damaged file can lose at most
LIBRARY = "drake_diff"
MAGIC = b"\x89MCAP0\r\n"
FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of summary, start of its offsets, CRC of the summary
DATA_END = struct.Struct("<BQI")  # opcode, length, CRC of all before it


@dataclass(frozen=True)
class Channel:
    """One topic: messages of one protobuf class with their log times [ns], and units or names as metadata."""

    topic: str
    message_class: Any
    messages: Sequence[tuple[int, Any]]
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class McapLog:
    """What a file holds: messages by topic, the channels' metadata, metadata records and attachments."""

    messages: dict[str, list[tuple[int, Any]]]
    channel_metadata: dict[str, dict[str, Any]]
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]


def write_mcap(
    path: Path, channels: Sequence[Channel], metadata: Mapping[str, str], attachments: Mapping[str, tuple[str, bytes]]
) -> None:
    """Write `channels` to `path`, aside and then moved into place; attachments are name: (media type, data)."""
    buffer = BytesIO()
    writer = Writer(
        buffer, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True
    )
    writer.start(profile="", library=LIBRARY)
    writer.add_metadata("run", dict(metadata))
    for name, (media_type, data) in attachments.items():
        writer.add_attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
    ids = [_register(writer, channel) for channel in channels]
    timed = [
        (time, rank, sequence, message)
        for rank, channel in enumerate(channels)
        for sequence, (time, message) in enumerate(channel.messages)
    ]
    for time, rank, sequence, message in sorted(timed, key=lambda row: row[:3]):
        writer.add_message(
            channel_id=ids[rank],
            log_time=time,
            publish_time=time,
            sequence=sequence,
            data=message.SerializeToString(deterministic=True),
        )
    writer.finish()
    write_whole(path, buffer.getvalue())


def _register(writer: Writer, channel: Channel) -> int:
    descriptor = channel.message_class.DESCRIPTOR
    schema = writer.register_schema(
        name=descriptor.full_name, encoding="protobuf", data=_descriptor_set(channel.message_class)
    )
    metadata = {key: json.dumps(value, sort_keys=True) for key, value in sorted(channel.metadata.items())}
    return int(writer.register_channel(channel.topic, "protobuf", schema, metadata))


def _descriptor_set(message_class: Any) -> bytes:
    found: FileDescriptorSet = build_file_descriptor_set(message_class)
    return bytes(found.SerializeToString(deterministic=True))


def read_mcap(path: str | Path) -> McapLog:
    """Everything in an MCAP file of protobuf channels, every CRC checked.

    Raises ArtifactError, naming the file, where it is missing, damaged or cut short.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read: {error}") from error
    log = McapLog({}, {}, {}, {})
    try:
        _check_crcs(data)
        _collect(data, log)
    except Exception as error:  # a damaged file makes the reader fail in many ways; none of them is ours
        raise ArtifactError(f"{path} is no whole MCAP file of this project: {type(error).__name__}: {error}") from error
    return log


def _check_crcs(data: bytes) -> None:
    """The checksums of the data section and of the summary; between them they cover every byte but the last magic.

    The format allows a file without them, the reader does not check them, and ours always has them.
    """
    if len(data) < len(MAGIC) + FOOTER.size or not data.endswith(MAGIC):
        raise McapError("it does not end as an MCAP file does: it was cut short")
    footer = len(data) - len(MAGIC) - FOOTER.size
    opcode, length, summary_start, _, summary_crc = FOOTER.unpack_from(data, footer)
    data_end = summary_start - DATA_END.size
    if (opcode, length) != (0x02, FOOTER.size - 9) or not 0 <= data_end <= footer:
        raise McapError("its footer is damaged")
    end_opcode, end_length, data_crc = DATA_END.unpack_from(data, data_end)
    if (end_opcode, end_length) != (0x0F, DATA_END.size - 9) or zlib.crc32(data[:data_end]) != data_crc:
        raise McapError("the checksum of its data does not match")
    if zlib.crc32(data[summary_start : len(data) - len(MAGIC) - 4]) != summary_crc:
        raise McapError("the checksum of its summary does not match")


def _collect(data: bytes, log: McapLog) -> None:
    def reader() -> NonSeekingReader:
        return NonSeekingReader(BytesIO(data), validate_crcs=True, decoder_factories=[DecoderFactory()])

    summary = reader().get_summary()
    if summary is None or summary.statistics is None:
        raise McapError("it has no summary: it was cut short")
    for channel in summary.channels.values():
        log.messages[channel.topic] = []
        log.channel_metadata[channel.topic] = {key: json.loads(text) for key, text in channel.metadata.items()}
    for _, channel, message, decoded in reader().iter_decoded_messages():
        log.messages[channel.topic].append((message.log_time, decoded))
    log.metadata.update({record.name: dict(record.metadata) for record in reader().iter_metadata()})
    log.attachments.update({a.name: bytes(a.data) for a in reader().iter_attachments()})
    counted = sum(len(messages) for messages in log.messages.values())
    if counted != summary.statistics.message_count:
        raise McapError(f"it holds {counted} messages, its statistics say {summary.statistics.message_count}")
