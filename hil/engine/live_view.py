"""The live view: an observer that serves a run over the Foxglove WebSocket protocol.

It only sends. Clients can neither publish nor call anything, and one that does not read loses the
oldest messages of its own queue; nothing waits for it.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import json
import re
import socket
import time
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from hil.core import HilError, PluginError, StructArray, bounded, plugins
from hil.engine.live_channels import PROGRESS_SCHEMA, PROGRESS_TOPIC, RobotTopics
from hil.engine.live_decimate import Decimation
from hil.engine.standing import Standing
from hil.engine.standing_words import words_of
from hil.recording import EVENT_TOPIC, encode_log
from hil.robot import Capabilities

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import WebSocketServer

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8765
"""Where Foxglove and Lichtblick look by default."""

PORTS_TRIED = 10
STOP_WITHIN_S = 1.0
STEPS_TOLD_EVERY_S = 0.05
LAYOUT = Path(__file__).with_name("hil-layout.json")
_IN_USE = re.compile(rf"os error ({errno.EADDRINUSE}|10048)\)")


class FoxgloveLive:
    """Serves one run to any number of viewers while it is open; an observer of the engine.

    Args:
        robot: Joint names, rate and units: `Robot.capabilities`.
        host: Address to listen on. The protocol knows no passwords: whoever reaches it can watch.
        port: TCP port, 0 for any; None for 8765 or, where that is taken, one of the next nine.
        name: Shown by viewers.
    """

    wants_rows = True

    def __init__(
        self,
        robot: Capabilities,
        *,
        host: str = LOOPBACK,
        port: int | None = None,
        name: str = "hil",
    ) -> None:
        self._topics = RobotTopics(robot)
        self._host, self._port, self._name = host, port, name
        self._decimation = Decimation()
        self._standing = Standing()
        # The server holds its context weakly: without this one it would advertise nothing.
        self._context: Context | None = None
        self._channels: dict[str, Channel] = {}
        self._server: WebSocketServer | None = None
        self._next_step = 0.0

    @property
    def url(self) -> str:
        """What to connect to; empty while it does not serve."""
        if self._server is None:
            return ""
        return f"ws://{_reachable(self._host)}:{self._server.port}"

    def start(self) -> None:
        """Begin to serve. Idempotent.

        Raises:
            PluginError: `foxglove-sdk` is not installed, or nobody can listen there.
        """
        if self._server is not None:
            return
        sdk = _sdk()
        self._context = context = sdk.Context()
        for topic, schema in self._topics.schemas.items():
            ros = sdk.Schema(name=schema.name, encoding="ros2msg", data=schema.text.encode())
            self._channels[topic] = sdk.Channel(
                topic, schema=ros, message_encoding="cdr", context=context
            )
        self._channels[PROGRESS_TOPIC] = sdk.Channel(
            PROGRESS_TOPIC, schema=PROGRESS_SCHEMA, context=context
        )
        self._server = self._listen(sdk, context)

    def stop(self) -> None:
        """Close every connection and the port, within a second. Idempotent.

        A client that is connected and does not read keeps the SDK waiting for it, perhaps for
        ever: such a one is left behind, and goes with the process.
        """
        server, self._server = self._server, None
        channels, self._channels = self._channels, {}
        contexts, self._context = [self._context], None
        if server is None:
            return

        def close() -> None:
            server.stop()
            # Not while clients are served: freeing a channel has blocked the whole process then.
            channels.clear()
            contexts.clear()

        with contextlib.suppress(HilError):
            bounded(close, STOP_WITHIN_S, "closing the live view")

    def __enter__(self) -> FoxgloveLive:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def notify(self, event: Mapping[str, Any]) -> None:
        """Serve an event; see `hil.engine.Observer`."""
        if event.get("kind") == "rows":
            if self._decimation.due():
                self._show(event["rows"])
            return
        self._standing.take(event)
        if event.get("kind") == "step" and not self._step_is_due():
            return
        if said := words_of(event, self._standing):
            self._tell(str(event["kind"]), *said)
        if channel := self._watched(PROGRESS_TOPIC):
            channel.log(json.dumps(self._standing.snapshot()))

    def _show(self, rows: StructArray) -> None:
        chosen, age = self._decimation.select(rows)
        now = time.time_ns()
        times = [now - int(seconds * 1e9) for seconds in age]
        for topic in self._topics.row_topics:
            if channel := self._watched(topic):
                for message, at in zip(self._topics.encode(topic, chosen), times, strict=True):
                    channel.log(message, log_time=at)

    def _tell(self, kind: str, level: int, text: str) -> None:
        if channel := self._watched(EVENT_TOPIC):
            channel.log(encode_log(time.time(), level, kind, text))

    def _step_is_due(self) -> bool:
        """On a virtual clock steps fly past; nobody reads a hundred a second."""
        now = time.monotonic()
        if now < self._next_step:
            return False
        self._next_step = now + STEPS_TOLD_EVERY_S
        return True

    def _watched(self, topic: str) -> Channel | None:
        """The channel of a topic if anybody looks at it: encoding for nobody would cost time."""
        channel = self._channels.get(topic)
        return channel if channel is not None and channel.has_sinks() else None

    def _listen(self, sdk: Any, context: Context) -> WebSocketServer:
        ports = [self._port]
        if self._port is None:
            ports = [DEFAULT_PORT + i for i in range(PORTS_TRIED)]
        for port in ports:
            try:
                server: WebSocketServer = sdk.start_server(
                    name=self._name, host=self._host, port=port, context=context
                )
            except RuntimeError as error:
                refusal = error
                if not _IN_USE.search(str(error)):
                    break
            else:
                return server
        raise _refused(self._host, ports, refusal) from refusal


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _sdk() -> Any:
    try:
        return import_module("foxglove")
    except ModuleNotFoundError as error:
        raise plugins.not_installed("the live view", ["foxglove"], "live") from error
    except ImportError as error:
        raise PluginError(
            f"the live view needs foxglove-sdk: {error}", hint='pip install "hil[live]"'
        ) from error


def _refused(host: str, ports: list[int | None], refusal: RuntimeError) -> PluginError:
    tried = f"{ports[0]}" if len(ports) == 1 else f"{ports[0]} to {ports[-1]}"
    why = str(refusal).removeprefix("FoxgloveError: ")
    return PluginError(
        f"the live view cannot listen on {host}, port {tried}: {why}",
        hint="another program has the port, perhaps another `hil run --live`: choose another "
        "with --live-port, 0 for any"
        if _IN_USE.search(str(refusal))
        else "give an address of this machine with --live-host",
    )


def _reachable(host: str) -> str:
    """What a viewer can connect to: "any address" is none."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if address.is_unspecified:
        return socket.gethostname()
    return f"[{address}]" if address.version == 6 else host
