"""The live view: an observer that serves a run over the Foxglove WebSocket protocol.

It only sends. Clients can neither publish nor call anything, and one that does not read loses the
oldest messages of its own queue; nothing waits for it. Topics and schemas are those of the
recording, so that one layout shows a run while it goes on and its MCAP file afterwards
(`RobotTopics`). A screen takes fewer rows than a robot delivers, and a mock on a virtual clock
delivers hundreds of blocks a second: `Decimation` selects what is shown.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import json
import re
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from hil.core import FloatArray, HilError, PluginError, StructArray, bounded, plugins
from hil.engine.standing import Event, Standing, message_of
from hil.recording import (
    EVENT_SCHEMA,
    EVENT_TEXT,
    EVENT_TOPIC,
    JOINT_STATE_SCHEMA,
    JOINT_STATE_TEXT,
    JOINT_STATE_TOPIC,
    MAX_RATE_HZ,
    JointStateView,
    encode_log,
)
from hil.robot import CDR_HEADER, Capabilities, Topic, state_topic

if TYPE_CHECKING:
    from foxglove import Channel, Context
    from foxglove.websocket import WebSocketServer

LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 8765
"""Where Foxglove and Lichtblick look by default."""

PORTS_TRIED = 10
CLOSE_WITHIN_S = 1.0

STEPS_EVERY_S = 0.05
"""On a virtual clock steps fly past; nobody reads a hundred a second [s]."""

LAYOUT = Path(__file__).with_name("hil-layout.json")
_IN_USE = re.compile(rf"os error ({errno.EADDRINUSE}|10048)\)")

TRACKING_TOPIC = "/robot/tracking_error"
PROGRESS_TOPIC = "/hil/progress"

PROGRESS_SCHEMA: dict[str, Any] = {
    "title": "hil.Progress",
    "type": "object",
    "properties": {
        key: {"type": {str: "string", int: "integer", float: "number"}[type(value)]}
        for key, value in Standing().snapshot().items()
    },
}
"""JSON Schema of `Standing.snapshot`."""


class FoxgloveLive:
    """Serves one run to any number of viewers while it is open; an observer of the engine.

    Args:
        robot: Joint names, rate and units: `Robot.capabilities`.
        host: Address to listen on. The protocol knows no passwords: whoever reaches it can watch.
        port: TCP port, 0 for any; None for 8765 or, where that is taken, one of the next nine.
    """

    wants_rows = True

    def __init__(
        self, robot: Capabilities, *, host: str = LOOPBACK, port: int | None = None
    ) -> None:
        self._topics = RobotTopics(robot)
        self._host, self._port = host, port
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
        host = self._host
        with contextlib.suppress(ValueError):  # a name, not an address
            address = ipaddress.ip_address(host)
            if address.is_unspecified:  # "any address" is none that a viewer can connect to
                host = socket.gethostname()
            elif address.version == 6:
                host = f"[{address}]"
        return f"ws://{host}:{self._server.port}"

    def start(self) -> None:
        """Begin to serve. Idempotent.

        Raises:
            PluginError: `foxglove-sdk` is not installed, or nobody can listen there.
        """
        if self._server is not None:
            return
        try:
            sdk = import_module("foxglove")
        except ModuleNotFoundError as error:
            raise plugins.not_installed("the live view", ["foxglove"], "live") from error
        except ImportError as error:
            raise PluginError(
                f"the live view needs foxglove-sdk: {error}", hint='pip install "hil[live]"'
            ) from error
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
            bounded(close, CLOSE_WITHIN_S, "closing the live view")

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

    def notify(self, event: Event) -> None:
        """Serve an event; see `hil.engine.Observer`."""
        kind = event.get("kind")
        if kind == "rows":
            if self._decimation.due():
                self._show(event["rows"])
            return
        self._standing.take(event)
        if kind == "step":
            now = time.monotonic()
            if now < self._next_step:
                return
            self._next_step = now + STEPS_EVERY_S
        message = message_of(event, self._standing)
        if message is not None and (channel := self._watched(EVENT_TOPIC)):
            level, text = message
            channel.log(encode_log(time.time(), level, str(kind), text))
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

    def _watched(self, topic: str) -> Channel | None:
        """Return the channel of a topic if it has a viewer: encoding for none costs time."""
        channel = self._channels.get(topic)
        return channel if channel is not None and channel.has_sinks() else None

    def _listen(self, sdk: Any, context: Context) -> WebSocketServer:
        ports = [self._port]
        if self._port is None:
            ports = [DEFAULT_PORT + i for i in range(PORTS_TRIED)]
        for port in ports:
            try:
                server: WebSocketServer = sdk.start_server(
                    name="hil", host=self._host, port=port, context=context
                )
            except RuntimeError as error:
                refusal = error
                if not _IN_USE.search(str(error)):
                    break
            else:
                return server
        raise _refused(self._host, ports, refusal) from refusal


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


@dataclass(frozen=True, slots=True)
class RosSchema:
    """A ROS 2 message definition, as viewers want it."""

    name: str
    text: str


class RobotTopics:
    """The topics of one robot: what they are called, and their messages.

    Args:
        robot: Joint names, rate and units.
    """

    def __init__(self, robot: Capabilities) -> None:
        n, unit = len(robot.joint_names), "A" if robot.effort_kind == "current" else "N·m"
        self._state = state_topic(n, robot.rate_hz, clock=robot.clock, effort_unit=unit)
        self._tracking = Topic(
            name=TRACKING_TOPIC,
            dtype=np.dtype(
                [
                    ("device_time", "<f8"),
                    ("host_time", "<f8"),
                    ("tracking_error", "<f8", (n,)),
                ]
            ),
            rate_hz=robot.rate_hz,
            clock=robot.clock,
            units={"device_time": "s", "host_time": "s (Unix time)", "tracking_error": "rad"},
            schema_name=f"hil/msg/TrackingError{n}",
        )
        self._joints = JointStateView(robot.joint_names, robot.rate_hz)

    @property
    def row_topics(self) -> tuple[str, ...]:
        """The topics that have a message for every row that is shown."""
        return JOINT_STATE_TOPIC, self._state.name, self._tracking.name

    @property
    def schemas(self) -> dict[str, RosSchema]:
        """Topic → schema, of everything that is CDR."""
        own = (self._state, self._tracking)
        return {
            JOINT_STATE_TOPIC: RosSchema(JOINT_STATE_SCHEMA, JOINT_STATE_TEXT),
            **{topic.name: RosSchema(topic.schema_name, topic.schema_text) for topic in own},
            EVENT_TOPIC: RosSchema(EVENT_SCHEMA, EVENT_TEXT),
        }

    def encode(self, topic: str, rows: StructArray) -> Iterator[bytes]:
        """Return one message per state row.

        Raises:
            ValueError: The rows have another number of joints than the robot.
        """
        if topic == JOINT_STATE_TOPIC:
            return (message.tobytes() for message in self._joints.encode(rows))
        if topic == self._tracking.name:
            tracking = np.empty(len(rows), self._tracking.dtype)
            tracking["device_time"] = rows["device_time"]
            tracking["host_time"] = rows["host_time"]
            tracking["tracking_error"] = rows["q_target"] - rows["q"]
            rows = tracking
        return (CDR_HEADER + row.tobytes() for row in rows)


AT_ONCE = 12
"""Rows shown of one block at most, so that a burst is no flood."""


class Decimation:
    """Lets at most `MAX_RATE_HZ` rows a second of *wall* time through, spread over what came in.

    A mock on a virtual clock delivers hundreds of blocks a second: most are turned away by one
    comparison.

    Args:
        clock: Monotonic wall clock [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last = clock()
        self._allowed = 1.0

    def due(self) -> int:
        """Return how many rows may be shown now."""
        return min(AT_ONCE, int(self._allowed + (self._clock() - self._last) * MAX_RATE_HZ))

    def select(self, rows: StructArray) -> tuple[StructArray, FloatArray]:
        """Select the rows to show, evenly spread and with the newest.

        Returns:
            Rows, and their age in wall time [s], shape (len(rows),): the time since the newest
            row by the device clock, shrunk where that runs faster than the wall.
        """
        n = min(self.due(), len(rows))
        if not n:
            return rows[:0], np.empty(0)
        every = -(-len(rows) // n)
        chosen = rows[(len(rows) - 1) % every :: every]
        now = self._clock()
        elapsed, self._last = now - self._last, now
        self._allowed = min(AT_ONCE, self._allowed + elapsed * MAX_RATE_HZ) - len(chosen)
        age = chosen["device_time"][-1] - chosen["device_time"]
        # The oldest comes after the newest of the last time: no viewer's time runs backwards.
        longest = elapsed * (1 - 1 / len(chosen))
        return chosen, age * min(1.0, longest / max(float(age[0]), 1e-9))
