"""A viewer for the tests: the Foxglove WebSocket protocol as its specification says, no SDK.

Server to client: `serverInfo` and `advertise` as JSON text; binary messages of opcode 1 with the
subscription's number (uint32), the log time (uint64, ns) and the payload, all little-endian.
(github.com/foxglove/ws-protocol, docs/spec.md)
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from functools import cached_property
from types import TracebackType
from typing import Any

from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

PROTOCOL = Subprotocol("foxglove.sdk.v1")


class Message:
    """One message, decoded by the schema that the server advertised when it is looked at."""

    def __init__(self, topic: str, log_time_ns: int, raw: bytes, decode: Any) -> None:
        self.topic = topic
        self.log_time_ns = log_time_ns
        self.raw, self._decode = raw, decode

    @cached_property
    def data(self) -> Any:
        return self._decode(self.raw)


class Viewer:
    """Connects and subscribes to everything, or to some topics, while it is open."""

    def __init__(self, url: str, topics: set[str] | None = None) -> None:
        self._url = url
        self._topics = topics
        self._open = ExitStack()

    def __enter__(self) -> Viewer:
        connection = connect(self._url, subprotocols=[PROTOCOL], max_size=None)
        self._socket = self._open.enter_context(connection)
        self.info = json.loads(self._socket.recv(timeout=10))
        advertised = json.loads(self._socket.recv(timeout=10))
        assert advertised["op"] == "advertise"
        self.channels = {c["topic"]: c for c in advertised["channels"]}
        self._of = {c["id"]: c for c in self.channels.values()}
        chosen = self._topics or set(self.channels)
        wanted = [self.channels[topic]["id"] for topic in chosen]
        subscriptions = [{"id": number, "channelId": number} for number in wanted]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        self._decoders = {number: _decoder(self._of[number]) for number in wanted}
        return self

    def messages(self, timeout_s: float = 60.0) -> Iterator[Message]:
        """Everything that comes, until the server closes the connection."""
        try:
            while True:
                raw = self._socket.recv(timeout=timeout_s)
                if isinstance(raw, bytes) and raw[0] == 1:
                    number, at = struct.unpack_from("<IQ", raw, 1)
                    decode = self._decoders[number]
                    yield Message(self._of[number]["topic"], at, raw[13:], decode)
        except ConnectionClosed:
            return

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()


def _decoder(channel: dict[str, Any]) -> Any:
    if channel["encoding"] == "json":
        return json.loads
    schema = Schema(1, channel["schema"].encode(), channel["schemaEncoding"], channel["schemaName"])
    decode = DecoderFactory().decoder_for(channel["encoding"], schema)
    assert decode is not None
    return decode
