"""An MCAP file of protobuf channels: written as it comes, byte for byte the same for the same content."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from heapq import merge
from pathlib import Path
from typing import Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from drake_diff._base.files import whole_file
from drake_diff.exceptions import InputError

CHUNK_SIZE = 64 * 1024  # the most that is lost if a process is killed or a file damaged
LIBRARY = "drake_diff"


@dataclass(frozen=True)
class Channel:
    """One topic: messages of one protobuf class with their log times [ns], in order; units or names as metadata."""

    topic: str
    message_class: Any
    messages: Iterable[tuple[int, Any]]
    metadata: Mapping[str, Any] = field(default_factory=dict)


def write_mcap(
    path: Path, channels: Sequence[Channel], metadata: Mapping[str, str], attachments: Mapping[str, tuple[str, bytes]]
) -> None:
    """Write `channels` to `path`; attachments are name: (media type, data).

    Written chunk by chunk beside `path`, and moved into place once it is whole. InputError if a time decreases.
    """
    with whole_file(path) as file:
        writer = start(file)
        writer.add_metadata("run", dict(metadata))
        for name, (media_type, data) in attachments.items():
            writer.add_attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        ids = [_register(writer, channel) for channel in channels]
        for time, rank, sequence, message in merge(*(_timed(rank, channel) for rank, channel in enumerate(channels))):
            data = message.SerializeToString(deterministic=True)
            writer.add_message(ids[rank], log_time=time, data=data, publish_time=time, sequence=sequence)
        writer.finish()


def start(file: Any) -> Writer:
    """The writer of all our files: small chunks, every checksum."""
    writer = Writer(
        file, chunk_size=CHUNK_SIZE, compression=CompressionType.ZSTD, enable_crcs=True, enable_data_crcs=True
    )
    writer.start(profile="", library=LIBRARY)
    return writer


def _timed(rank: int, channel: Channel) -> Iterator[tuple[int, int, int, Any]]:
    last = 0
    for sequence, (time, message) in enumerate(channel.messages):
        if time < last:
            raise InputError(f"time of message {sequence} of {channel.topic}", got=time, expected=f"at least {last}")
        last = time
        yield time, rank, sequence, message


def _register(writer: Writer, channel: Channel) -> int:
    descriptors: FileDescriptorSet = build_file_descriptor_set(channel.message_class)
    data = bytes(descriptors.SerializeToString(deterministic=True))
    schema = writer.register_schema(name=channel.message_class.DESCRIPTOR.full_name, encoding="protobuf", data=data)
    metadata = {key: json.dumps(value, sort_keys=True) for key, value in sorted(channel.metadata.items())}
    return int(writer.register_channel(channel.topic, "protobuf", schema, metadata))
