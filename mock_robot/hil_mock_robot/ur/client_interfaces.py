"""Client interfaces of the mock controller: primary (30001), secondary (30002), real-time (30003).

Primary and secondary clients receive the robot state at 10 Hz (`state_packet`, a packet of
sub-packages); primary clients also receive messages (`messages_of`). A text in a message extends to
the end of the message. Real-time clients receive one packet of doubles per tick (`RealtimePacket`).
All numbers in the packets are big-endian. Data from clients of all three ports are script text:
`ScriptInbox` splits the text into programs, which are played, and executes lines that are not
URScript (`CONTROL_LINES`). The manufacturer does not document all control lines; `CONTROL_LINES`
contains the lines that known clients send (UR's client library, python-urx and its predecessors).

The source of the message formats is Universal Robots, "Primary and Secondary Interfaces", robot
state message of 3.15 and 5.10, messages to clients. A state packet of the e-Series has 1386 bytes,
like that of software 5.8 in the tests of UR's client library. A CB3 controller (UR10, 3.5.3) sends
1350 bytes (python-urx issue 65): the tool data in sub-packages 11 and 12 and the last byte of the
master board are missing in that packet. UR's client library reads the last byte of the master board
on both series. Source of the real-time interface: Universal Robots, "Realtime Client Interface",
tables up to 5.10.
"""

from __future__ import annotations

import math
import re
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache

from hil.arms import ArmDescription
from hil_mock_robot.plant.records import FAULTS, PROTECTIVE_STOP, RUNAWAY
from hil_mock_robot.ur.connections import Link
from hil_mock_robot.ur.machine import Event, Machine
from hil_mock_robot.ur.modes import RobotMode, RuntimeState, SafetyMode
from hil_mock_robot.ur.rtde_variables import Series, Values
from hil_mock_robot.ur.script_parsing import opens_block, stripped
from hil_mock_robot.ur.scripts import play, run_beside

PRIMARY, SECONDARY = 30001, 30002
RATE_HZ = 10

MOST_PENDING = 200_000
"""Maximum number of bytes that wait for a client that does not read; further messages to this
client are dropped as a whole."""

OWN_CODES = 10
"""Smallest error code of UR (C…); smaller codes are those of `plant.records.FAULTS`."""

ERROR_CODES = {1: 153, 2: 157, RUNAWAY: 153, PROTECTIVE_STOP: 158}
"""Map from fault of the plant to error code of UR: C153 (position deviates from path), C157 (a
joint collides), C158 (the arm collides)."""


class PrimaryService:
    """Service of port 30001 (state and messages) or port 30002 (state only).

    Args:
        machine: Simulated controller.
        port: TCP port: 30001 or 30002.

    Attributes:
        port: TCP port of the service.
        sessions: Sessions of the connected clients.
    """

    def __init__(self, machine: Machine, port: int = PRIMARY) -> None:
        self.machine, self.port = machine, port
        self.sessions: list[PrimarySession] = []
        self._safety = machine.modes.safety
        if port == PRIMARY:
            machine.listeners.append(self._heard)

    def accept(self, link: Link) -> PrimarySession:
        """Send the version message to a new client.

        The session of this client then sends the states.
        """
        if not self.sessions:
            self._safety = self.machine.modes.safety
        session = PrimarySession(self, link)
        self.sessions.append(session)
        return session

    def watch_safety(self) -> None:
        """Send a message if the safety mode has changed since the last tick."""
        safety = self.machine.modes.safety
        if safety is not self._safety:
            self._safety = safety
            if self.port == PRIMARY:
                self._tell(safety_mode_message(int(safety), self.machine.now_s))

    def _heard(self, event: Event) -> None:
        for each in messages_of(event, self.machine.now_s):
            self._tell(each)

    def _tell(self, message: bytes) -> None:
        for session in list(self.sessions):
            session.tell(message)


class PrimarySession:
    """Session of one primary or secondary client.

    Args:
        service: Service to which this session belongs.
        link: Connection to the client.
    """

    lossless = False

    def __init__(self, service: PrimaryService, link: Link) -> None:
        self._service, self._link = service, link
        self._inbox = ScriptInbox(service.machine)
        self._sent = -1
        link.send(greeting(service.machine.series))
        self._publish()

    def received(self, data: bytes) -> None:
        """Add received bytes to the script text of the client; see `Session`."""
        self._inbox.feed(data)

    def ticked(self) -> None:
        """See `Session`."""
        self._service.watch_safety()
        self._publish()

    def hung_up(self) -> None:
        """See `Session`."""
        self._service.sessions.remove(self)

    def tell(self, message: bytes) -> None:
        """Send a message unless too many bytes wait for the client."""
        if not self._link.closed and self._link.pending < MOST_PENDING:
            self._link.send(message)

    def _publish(self) -> None:
        """Send the state if a packet is due and the previous packet has been sent completely."""
        machine = self._service.machine
        due = machine.ticks * RATE_HZ // round(machine.series.rate_hz)
        if due != self._sent and not self._link.pending:
            self._sent = due
            self._link.send(state_packet(machine))


def messages_of(event: Event, now_s: float) -> list[bytes]:
    """Return the messages to a primary client about an event."""
    kind, name, text = event.kind, event.name, event.text
    if kind == "program_started":
        return [key_message("PROGRAM_XXX_STARTED", name, now_s)]
    if kind == "program_stopped":
        return [key_message("PROGRAM_XXX_STOPPED", name, now_s)]
    if kind == "popup":
        return [popup_message(name, text, now_s)]
    if kind == "error":
        return _error_messages(event, now_s)
    if kind in ("protective_stop", "fault"):
        code = event.code if event.code >= OWN_CODES else ERROR_CODES.get(event.code, 0)
        level = Level.FAULT if kind == "fault" else Level.VIOLATION
        return [error_message(code, level, text or FAULTS.get(event.code, kind), now_s)]
    if kind in ("text", "watchdog", "refused"):
        return [text_message(text or kind, now_s)]
    return []


def _error_messages(event: Event, now_s: float) -> list[bytes]:
    """Return the messages about a runtime error: exception, log line and error code.

    The log line is added if the exception message contains only a token of the program.
    """
    place = event.place
    messages = [exception_message(place.token or event.text, now_s, place.line, place.column)]
    if place.token:
        messages.append(text_message(event.text, now_s))
    if event.code:
        messages.append(error_message(event.code, Level.FAULT, event.text, now_s))
    return messages


ROBOT_MESSAGE = 20
CONTROLLER_NAME = b"URControl"

UNTIMED = 0xFFFFFFFFFFFFFFFF
"""Time value in the messages that are sent to a new client.

Clients that identify a packet by its first bytes, such as python-urx, sometimes mistake a
real time for a packet.
"""


class Source(IntEnum):
    """Source of a message."""

    ROBOT_INTERFACE = -2
    RT_MACHINE = -3
    SAFETY = 20
    CONTROLLER = 7
    GUI = -5


class Level(IntEnum):
    """Severity of an error code."""

    INFO = 1
    WARNING = 2
    VIOLATION = 3
    FAULT = 4


def message(
    kind: int, body: bytes, now_s: float | None, source: Source = Source.ROBOT_INTERFACE
) -> bytes:
    """Return a robot message: size, type, time [µs], source, kind of message, body."""
    time_us = UNTIMED if now_s is None else round(now_s * 1e6)
    head = struct.pack(">BQbb", ROBOT_MESSAGE, time_us, source, kind)
    return struct.pack(">i", 4 + len(head) + len(body)) + head + body


def text_message(text: str, now_s: float) -> bytes:
    """Return a log message (kind 0)."""
    return message(0, text.encode(), now_s, Source.RT_MACHINE)


def popup_message(title: str, text: str, now_s: float) -> bytes:
    """Return a popup message that needs no answer (kind 2)."""
    name = title.encode()[:255]
    body = struct.pack(">II???B", 0, 0, False, False, False, len(name))
    return message(2, body + name + text.encode(), now_s, Source.RT_MACHINE)


def greeting(series: Series) -> bytes:
    """Return the first two messages to a client: version (kind 3) and an undocumented kind 12.

    The two messages contain no time and no build number, like those of controllers and of URSim
    3.10, 5.12 and 5.13.
    """
    return _version(series) + message(12, struct.pack(">iiB", 0, 0, 1), None)


def _version(series: Series) -> bytes:
    major, minor, bugfix, _ = series.version
    date = time.strftime("%d-%m-%Y, %H:%M:%S", time.strptime(series.date, "%b %d %Y"))
    body = (
        struct.pack(">b", len(CONTROLLER_NAME))
        + CONTROLLER_NAME
        + struct.pack(">BBii", major, minor, bugfix, 0)
    )
    return message(3, body + date.encode(), None)


def safety_mode_message(mode: int, now_s: float) -> bytes:
    """Return the message about a change of the safety mode (kind 5)."""
    return message(5, struct.pack(">iiBII", 0, 0, mode, 0, 0), now_s, Source.SAFETY)


def error_message(code: int, level: Level, text: str, now_s: float) -> bytes:
    """Return the message about an error code C… (kind 6)."""
    body = struct.pack(">iiiII", code, 0, level, 0, 0)
    return message(6, body + text.encode(), now_s, Source.CONTROLLER)


def key_message(title: str, text: str, now_s: float) -> bytes:
    """Return a key message, for example about the start of a program (kind 7)."""
    name = title.encode()[:255]
    body = struct.pack(">iiB", 0, 0, len(name))
    return message(7, body + name + text.encode(), now_s)


def exception_message(text: str, now_s: float, line: int = 1, column: int = 1) -> bytes:
    """Return the message about a program that has failed (kind 10)."""
    body = struct.pack(">II", line, column) + text.encode()
    return message(10, body, now_s, Source.RT_MACHINE)


ROBOT_STATE = 16
EMERGENCY = (SafetyMode.ROBOT_EMERGENCY_STOP, SafetyMode.SYSTEM_EMERGENCY_STOP)
PROTECTIVE = (SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP)
BOX_C, SUPPLY_V = 24.0, 48.0
AUTOMATIC, PRESSED = 1, 1
TOOL_BAUD = 115_200


def state_packet(machine: Machine) -> bytes:
    """Return the robot state that is published at 10 Hz."""
    parts = b"".join(
        struct.pack(">IB", 5 + len(body), kind) + body for kind, body in _parts(machine)
    )
    return struct.pack(">iB", 5 + len(parts), ROBOT_STATE) + parts


def _parts(machine: Machine) -> Iterator[tuple[int, bytes]]:
    """Yield type and content of the sub-packages, in the order of a real controller."""
    yield 0, _robot_mode(machine)
    yield 1, _joints(machine)
    yield 4, _cartesian(machine)
    yield 5, kinematics(machine.body.arm)
    yield 9, bytes(48)  # calibration data, for UR's own software only
    yield 3, _master_board(machine)
    yield 2, _tool(machine)
    yield 6, configuration(machine.body.arm, machine.series)
    yield 7, _force_mode(machine)
    yield 8, bytes((0, 1, 0, 1)) if machine.series.is_e else bytes((0, 1, 0))
    yield 10, bytes(38)  # safety data, for UR's own software only
    if not machine.series.is_e:
        return
    yield 11, struct.pack(">?iiiff", False, TOOL_BAUD, 0, 1, 1.5, 3.5)
    yield 12, bytes((0, 1, 1))


def _robot_mode(machine: Machine) -> bytes:
    modes, out = machine.modes, machine.outputs
    powered = modes.robot >= RobotMode.POWER_ON
    return struct.pack(
        ">Q7?BB3dB",
        round(machine.now_s * 1e6),
        True,
        modes.robot is RobotMode.RUNNING,
        powered,
        modes.safety in EMERGENCY,
        modes.safety in PROTECTIVE,
        machine.runtime is RuntimeState.PLAYING,
        machine.runtime is RuntimeState.PAUSED,
        int(modes.robot) & 0xFF,
        0,
        out["target_speed_fraction"],
        out["speed_scaling"],
        1.0,
        0,
    )


def _joints(machine: Machine) -> bytes:
    out = machine.outputs
    columns = zip(
        out["actual_q"],
        out["target_q"],
        out["actual_qd"],
        out["actual_current"],
        out["actual_joint_voltage"],
        out["joint_temperatures"],
        (0.0,) * 6,
        out["joint_mode"],
        strict=True,
    )
    return b"".join(struct.pack(">3d4fB", *joint) for joint in columns)


def _cartesian(machine: Machine) -> bytes:
    return struct.pack(">12d", *machine.outputs["actual_TCP_pose"], *machine.tcp)


def _master_board(machine: Machine) -> bytes:
    out, safety = machine.outputs, machine.modes.safety
    types = out["analog_io_types"]
    body = struct.pack(
        ">IIBBddBBddffff",
        out["actual_digital_input_bits"] & 0xFFFFFFFF,
        out["actual_digital_output_bits"] & 0xFFFFFFFF,
        types & 1,
        types >> 1 & 1,
        out["standard_analog_input0"],
        out["standard_analog_input1"],
        types >> 2 & 1,
        types >> 3 & 1,
        out["standard_analog_output0"],
        out["standard_analog_output1"],
        BOX_C,
        SUPPLY_V,
        out["actual_robot_current"],
        out["io_current"],
    )
    reduced = safety is SafetyMode.REDUCED
    return body + struct.pack(">B??IBBB", int(safety), reduced, False, 0, AUTOMATIC, PRESSED, 0)


def _tool(machine: Machine) -> bytes:
    out = machine.outputs
    types = out["tool_analog_input_types"]
    return struct.pack(
        ">BBddfBffB",
        types & 1,
        types >> 1 & 1,
        out["tool_analog_input0"],
        out["tool_analog_input1"],
        SUPPLY_V,
        out["tool_output_voltage"] & 0xFF,
        out["tool_output_current"],
        out["tool_temperature"],
        out["tool_mode"] & 0xFF,
    )


def _force_mode(machine: Machine) -> bytes:
    return struct.pack(">7d", *machine.outputs["actual_TCP_force"], 0.0)


UNCALIBRATED = 0xFFFFFFFF

MOTION_DEFAULTS = (1.0472, 1.3963, 0.25, 1.2, 0.25)
"""Default joint speed [rad/s], joint acceleration, tool speed [m/s], tool acceleration, blend
radius [m].
"""

ROBOT_TYPES = {"ur5": 1, "ur10": 2, "ur3": 3}
BOARD_E, BOX_E, SUBTYPE_E = 6, 4, 3
BOARD_CB3, BOX_CB3, SUBTYPE_CB3 = 5, 2, 1


@cache
def kinematics(arm: ArmDescription) -> bytes:
    """Return sub-package 5 with the DH parameters; the mock sends the published parameters."""
    a, alpha, d, theta = arm.dh.T.tolist()
    return struct.pack(">6I24dI", *(UNCALIBRATED,) * 6, *theta, *a, *d, *alpha, 0)


@cache
def configuration(arm: ArmDescription, series: Series) -> bytes:
    """Return sub-package 6: joint limits, motion defaults, DH parameters and hardware type."""
    a, alpha, d, theta = arm.dh.T.tolist()
    ranges = [each for pair in zip(arm.q_min, arm.q_max, strict=True) for each in pair]
    motion = [each for pair in zip(arm.qd_max, arm.qdd_max, strict=True) for each in pair]
    numbers = struct.pack(">53d", *ranges, *motion, *MOTION_DEFAULTS, *a, *d, *alpha, *theta)
    kind = ROBOT_TYPES[arm.name.removesuffix("e")]
    if series.is_e:
        return numbers + struct.pack(">4i", BOARD_E, BOX_E, kind, SUBTYPE_E)
    return numbers + struct.pack(">4i", BOARD_CB3, BOX_CB3, kind, SUBTYPE_CB3)


REALTIME_FIELDS: tuple[tuple[str, int], ...] = (
    ("timestamp", 1),
    ("target_q", 6),
    ("target_qd", 6),
    ("target_qdd", 6),
    ("target_current", 6),
    ("target_moment", 6),
    ("actual_q", 6),
    ("actual_qd", 6),
    ("actual_current", 6),
    ("joint_control_output", 6),
    ("actual_TCP_pose", 6),
    ("actual_TCP_speed", 6),
    ("actual_TCP_force", 6),
    ("target_TCP_pose", 6),
    ("target_TCP_speed", 6),
    ("actual_digital_input_bits", 1),
    ("joint_temperatures", 6),
    ("", 2),  # run time of the controller's thread, and a test value
    ("robot_mode", 1),
    ("joint_mode", 6),
    ("safety_mode", 1),
    ("", 6),
    ("actual_tool_accelerometer", 3),
    ("", 6),
    ("speed_scaling", 1),
    ("actual_momentum", 1),
    ("", 2),
    ("actual_main_voltage", 1),
    ("actual_robot_voltage", 1),
    ("actual_robot_current", 1),
    ("actual_joint_voltage", 6),
    ("actual_digital_output_bits", 1),
    ("runtime_state", 1),
)
"""RTDE name of each field and its number of doubles; `""` for zeros."""

ELBOW_FIELDS = (("elbow_position", 3), ("elbow_velocity", 3))
SAFETY_FIELDS = (("safety_status", 1),)
PAYLOAD_FIELDS = (("", 3), ("payload", 1), ("payload_cog", 3), ("payload_inertia", 6))


def realtime_fields_of(series: Series) -> tuple[tuple[str, int], ...]:
    """Return the fields of a real-time packet.

    The number of fields depends on the software version.
    """
    fields = REALTIME_FIELDS
    for more, cb3, e in (
        (ELBOW_FIELDS, (3, 5), (5, 0)),
        (SAFETY_FIELDS, (3, 10), (5, 4)),
        (PAYLOAD_FIELDS, None, (5, 10)),
    ):
        if series.at_least(cb3, e):
            fields += more
    return fields


@dataclass(frozen=True, slots=True)
class RealtimePacket:
    """Layout of a real-time packet that is filled from RTDE outputs.

    Attributes:
        places: Index in `Values.flat` of each double of the packet; -1 for a double that is always
            zero.
        layout: Binary layout of the packet: size, then the doubles, big-endian.
    """

    places: tuple[int, ...]
    layout: struct.Struct

    def pack(self, outputs: Values) -> bytes:
        """Return the packet with the present values of the outputs."""
        flat = outputs.flat
        doubles = [flat[i] if i >= 0 else 0.0 for i in self.places]
        return self.layout.pack(self.layout.size, *doubles)


def realtime_packet_of(series: Series, outputs: Values) -> RealtimePacket:
    """Return the layout of the real-time packet for a controller's software."""
    places: list[int] = []
    for name, count in realtime_fields_of(series):
        known = outputs.variables.get(name)
        places += known.places if known is not None else [-1] * count
    return RealtimePacket(tuple(places), struct.Struct(f">i{len(places)}d"))


class RealtimeService:
    """Service of the real-time interface, port 30003.

    Args:
        machine: Simulated controller.

    Attributes:
        port: TCP port of the service.
    """

    port = 30003

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._packet = realtime_packet_of(machine.series, machine.outputs)

    def accept(self, link: Link) -> RealtimeSession:
        """Return the session of a new client, which sends packets from the next tick on."""
        return RealtimeSession(self._machine, self._packet, link)


class RealtimeSession:
    """Session of one real-time client, which possibly only sends programs and never reads.

    Args:
        machine: Simulated controller.
        packet: Layout of the real-time packet.
        link: Connection to the client.

    Attributes:
        dropped: Number of packets dropped because the client was too slow.
    """

    lossless = False

    def __init__(self, machine: Machine, packet: RealtimePacket, link: Link) -> None:
        self._machine, self._packet, self._link = machine, packet, link
        self._inbox = ScriptInbox(machine)
        self.dropped = 0

    def received(self, data: bytes) -> None:
        """Add received bytes to the script text of the client; see `Session`."""
        self._inbox.feed(data)

    def ticked(self) -> None:
        """Send the packet of this tick, or drop it if the previous packet is still being sent."""
        if self._link.pending:
            self.dropped += 1
        else:
            self._link.send(self._packet.pack(self._machine.outputs))

    def hung_up(self) -> None:
        """See `Session`."""


LARGEST_TEXT = 1_000_000
"""Maximum length of a program [bytes]."""

MOST_LINES = 20_000
"""Maximum number of lines of one program; all lines are parsed between two ticks."""

_BEGINS = re.compile(r"(def|sec)\b")
_SECONDARY = re.compile(r"\s*sec\b")


class ScriptInbox:
    """Splitter of the script text that one client sends to port 30001, 30002 or 30003.

    A program ends with the `end` of its `def`, or, if its body is indented, with an unindented
    `end`. A statement outside any `def` is a separate program. A received program stops the playing
    program. The playing program continues during secondary programs (`sec`) and after
    `CONTROL_LINES` that do not affect this program. In local control, an e-Series controller
    ignores all received text.

    Args:
        machine: Controller that plays the programs.
    """

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._rest = bytearray()
        self._lines: list[str] = []
        self._size = self._open = 0
        self._indented = self._deaf = False

    def feed(self, data: bytes) -> None:
        """Process received bytes; after a program that is too long, ignore all further bytes."""
        if self._deaf:
            return
        self._rest += data
        *lines, rest = self._rest.split(b"\n")
        self._rest = bytearray(rest)
        if len(rest) > LARGEST_TEXT:
            self._drop()
        for line in lines:
            if self._deaf:
                return
            self._take(line.decode("utf-8", "replace").rstrip("\r").replace("\0", ""))

    def _take(self, line: str) -> None:
        bare = stripped(line)
        if not self._lines and not bare:
            return
        self._lines.append(line)
        self._size += len(line) + 1
        if self._size > LARGEST_TEXT or len(self._lines) > MOST_LINES:
            self._drop()
        elif len(self._lines) == 1:
            self._open = int(_BEGINS.match(bare) is not None)
            self._indented = False
        else:
            self._count(line, bare)
        if self._lines and self._open == 0:
            self._play()

    def _count(self, line: str, bare: str) -> None:
        if len(self._lines) == 2:
            self._indented = line[:1].isspace()
        if opens_block(bare):
            self._open += 1
        elif bare == "end":
            outermost = self._indented and not line[:1].isspace()
            self._open = 0 if outermost else self._open - 1

    def _play(self) -> None:
        text = "\n".join(self._lines) + "\n"
        self._forget()
        machine = self._machine
        if machine.series.is_e and not machine.modes.remote:
            return
        if obey_line(stripped(text) if text.count("\n") == 1 else "", machine):
            return
        if _SECONDARY.match(text):
            run_beside(text, machine)
        else:
            play(text, machine)

    def _drop(self) -> None:
        self._deaf = True
        self._rest.clear()
        self._forget()
        most = f"{LARGEST_TEXT} bytes or {MOST_LINES} lines"
        self._machine.tell("error", text=f"a program is longer than {most}")

    def _forget(self) -> None:
        self._lines, self._size, self._open = [], 0, 0


SET_SPEED = "set speed "


def _nothing(machine: Machine) -> None:
    """Accept a control line without effect; the line concerns simulated arms or hand guiding."""


def _run(machine: Machine) -> None:
    """Switch the arm on and release its brakes; a running arm is not affected."""
    machine.modes.release_brakes()


CONTROL_LINES: Mapping[str, Callable[[Machine], object]] = {
    "pause program": lambda machine: machine.pause(),
    "power off": lambda machine: machine.modes.power_off(),
    "power on": lambda machine: machine.modes.power_on(),
    "resume program": lambda machine: machine.resume(),
    "run program": _nothing,
    "set real": _nothing,
    "set robotmode freedrive": _nothing,
    "set robotmode run": _run,
    "set sim": _nothing,
    "set unlock protective stop": lambda machine: machine.modes.unlock(),
    "stop program": lambda machine: machine.halt(),
}


def obey_line(line: str, machine: Machine) -> bool:
    """Execute a control line; return False if the line is not a control line but a program.

    Args:
        line: Line without comment and surrounding whitespace.
        machine: Simulated controller.
    """
    words = " ".join(line.split())
    if words.startswith(SET_SPEED):
        return _set_speed(words.removeprefix(SET_SPEED), machine)
    action = CONTROL_LINES.get(words)
    if action is None:
        return False
    action(machine)
    return True


def _set_speed(text: str, machine: Machine) -> bool:
    try:
        fraction = float(text)
    except ValueError:
        return False
    if math.isfinite(fraction):
        machine.speed_fraction = min(max(fraction, 0.0), 1.0)
    return True
