"""Live view: an observer that streams a run over the Foxglove WebSocket protocol.

The live view only sends data to its clients. Clients of the live view can neither publish data nor
call services. If a client does not read its messages, the oldest messages in the queue of the
client are dropped, and the run never waits for a client. The live view has the same topics and
schemas as the recording, so that one layout displays a run in progress and later its MCAP file
(`RobotTopics`). A screen needs fewer rows than a robot delivers, and a mock robot on a virtual
clock delivers hundreds of blocks per second: `Decimation` selects the rows to show.
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
"""Default TCP port to which the viewers Foxglove and Lichtblick connect."""

PORTS_TRIED = 10
CLOSE_WITHIN_S = 1.0

STEPS_EVERY_S = 0.05
"""Minimum wall time between two displayed plan steps [s], because steps on a virtual clock are
very short."""

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
    """Observer of the engine that streams one run to any number of viewers.

    Args:
        robot: Joint names, rate and units of the robot: `Robot.capabilities`.
        host: Network address on which the server listens. The Foxglove protocol has no passwords:
            everyone who can reach the address can watch the run.
        port: TCP port; 0 for any free port; None for 8765 or, if port 8765 is in use, one of the
            next nine ports.
    """

    wants_rows = True

    def __init__(
        self, robot: Capabilities, *, host: str = LOOPBACK, port: int | None = None
    ) -> None:
        self._topics = RobotTopics(robot)
        self._host, self._port = host, port
        self._decimation = Decimation()
        self._standing = Standing()
        # The server has only a weak reference to its context; this reference keeps the context
        # alive.
        self._context: Context | None = None
        self._channels: dict[str, Channel] = {}
        self._server: WebSocketServer | None = None
        self._next_step = 0.0

    @property
    def url(self) -> str:
        """URL to which clients connect; empty while the server is not running."""
        if self._server is None:
            return ""
        host = self._host
        with contextlib.suppress(ValueError):  # the host is a name, not an address
            address = ipaddress.ip_address(host)
            if address.is_unspecified:  # a viewer cannot connect to the unspecified address
                host = socket.gethostname()
            elif address.version == 6:
                host = f"[{address}]"
        return f"ws://{host}:{self._server.port}"

    def start(self) -> None:
        """Start the server. Idempotent.

        Raises:
            PluginError: `foxglove-sdk` is not installed, or the address cannot be used.
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
        """Close all client connections and the port within one second.

        Idempotent.

        The Foxglove SDK waits, possibly forever, for a connected client that does not read its
        messages. The connection to a client that does not read is abandoned and ends with the
        process.
        """
        server, self._server = self._server, None
        channels, self._channels = self._channels, {}
        contexts, self._context = [self._context], None
        if server is None:
            return

        def close() -> None:
            server.stop()
            # Only after the server has stopped, because freeing a channel while clients were served
            # has blocked the whole process.
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
        """Stream an event of the run to the viewers; see `hil.engine.Observer`."""
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
        """Return the channel of a topic, or None if no client views the topic.

        Messages that no client views are not encoded, because encoding takes time.
        """
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
        hint="a different program uses the port, possibly another `hil run --live`: choose a "
        "different port with --live-port (0: any free port)"
        if _IN_USE.search(str(refusal))
        else "give an address of this machine with --live-host",
    )


@dataclass(frozen=True, slots=True)
class RosSchema:
    """ROS 2 message definition of a topic in the text form that viewers need."""

    name: str
    text: str


class RobotTopics:
    """Topics of one robot: names, schemas and message encoding.

    Args:
        robot: Joint names, rate and units of the robot.
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
        """Names of the topics that have one message per displayed row."""
        return JOINT_STATE_TOPIC, self._state.name, self._tracking.name

    @property
    def schemas(self) -> dict[str, RosSchema]:
        """Schemas of all CDR topics by topic name."""
        own = (self._state, self._tracking)
        return {
            JOINT_STATE_TOPIC: RosSchema(JOINT_STATE_SCHEMA, JOINT_STATE_TEXT),
            **{topic.name: RosSchema(topic.schema_name, topic.schema_text) for topic in own},
            EVENT_TOPIC: RosSchema(EVENT_SCHEMA, EVENT_TEXT),
        }

    def encode(self, topic: str, rows: StructArray) -> Iterator[bytes]:
        """Return one encoded message of a topic per state row.

        Raises:
            ValueError: The number of joints in the rows differs from the number of joints of the
                robot.
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
"""Maximum number of displayed rows per block, which limits bursts."""


class Decimation:
    """Selection of at most `MAX_RATE_HZ` rows per second of *wall* time, evenly spread.

    A mock robot on a virtual clock delivers hundreds of blocks per second; one comparison rejects
    most of these blocks.

    Args:
        clock: Function that returns the monotonic wall time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._last = clock()
        self._allowed = 1.0

    def due(self) -> int:
        """Return the maximum number of rows that can be displayed now."""
        return min(AT_ONCE, int(self._allowed + (self._clock() - self._last) * MAX_RATE_HZ))

    def select(self, rows: StructArray) -> tuple[StructArray, FloatArray]:
        """Select the rows of a block to display, evenly spread and including the newest row.

        Returns:
            The selected rows, and the age of each row in wall time [s], shape (number of selected
            rows,). The age of a row is the device time from this row to the newest row, scaled down
            if the device clock runs faster than the wall clock.
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
        # The oldest row must be later than the newest row of the last call, so that time stamps
        # never decrease.
        longest = elapsed * (1 - 1 / len(chosen))
        return chosen, age * min(1.0, longest / max(float(age[0]), 1e-9))
