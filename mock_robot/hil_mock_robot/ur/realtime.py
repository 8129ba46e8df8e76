"""The real-time interface: one packet of doubles per tick, for whoever reads in time.

Source: Universal Robots, "Realtime Client Interface", tables up to 5.10.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from hil_mock_robot.ur.contracts import Link
from hil_mock_robot.ur.inbox import ScriptInbox
from hil_mock_robot.ur.machine import Machine
from hil_mock_robot.ur.variables import Series, Values

BASE: tuple[tuple[str, int], ...] = (
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
    ("", 2),  # run time of the controller's thread; a test value
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
"""RTDE's name for each field, and how many doubles it is; `""`: zeros."""

ELBOW = (("elbow_position", 3), ("elbow_velocity", 3))
SAFETY = (("safety_status", 1),)
PAYLOAD = (("", 3), ("payload", 1), ("payload_cog", 3), ("payload_inertia", 6))


def fields_of(series: Series) -> tuple[tuple[str, int], ...]:
    """Fields of a packet, which have grown from version to version."""
    fields = BASE
    for more, cb3, e in (
        (ELBOW, (3, 5), (5, 0)),
        (SAFETY, (3, 10), (5, 4)),
        (PAYLOAD, None, (5, 10)),
    ):
        if series.at_least(cb3, e):
            fields += more
    return fields


@dataclass(frozen=True, slots=True)
class Packet:
    """How a packet is made of RTDE's outputs.

    Attributes:
        places: Where each double lies in `Values.flat`, -1 for a zero.
        layout: Size and doubles, big-endian.
    """

    places: tuple[int, ...]
    layout: struct.Struct

    def pack(self, outputs: Values) -> bytes:
        """The packet of this tick."""
        flat = outputs.flat
        doubles = [flat[i] if i >= 0 else 0.0 for i in self.places]
        return self.layout.pack(self.layout.size, *doubles)


def packet_of(series: Series, outputs: Values) -> Packet:
    """The packet of a controller's software."""
    places: list[int] = []
    for name, count in fields_of(series):
        known = outputs.variables.get(name)
        places += known.places if known is not None else [-1] * count
    return Packet(tuple(places), struct.Struct(f">i{len(places)}d"))


class RealtimeService:
    """Port 30003.

    Args:
        machine: The controller.

    Attributes:
        port: TCP port.
    """

    port = 30003

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._packet = packet_of(machine.series, machine.outputs)

    def accept(self, link: Link) -> RealtimeSession:
        """Packets follow from the next tick on."""
        return RealtimeSession(self._machine, self._packet, link)


class RealtimeSession:
    """One client; it may only send programs and never read.

    Args:
        machine: The controller.
        packet: What it is sent.
        link: The connection.

    Attributes:
        dropped: Packets that it did not take in time.
    """

    lossless = False

    def __init__(self, machine: Machine, packet: Packet, link: Link) -> None:
        self._machine, self._packet, self._link = machine, packet, link
        self._inbox = ScriptInbox(machine)
        self.dropped = 0

    def received(self, data: bytes) -> None:
        """See `Session`: a piece of a program."""
        self._inbox.feed(data)

    def ticked(self) -> None:
        """See `Session`: what is left of the last packet comes first, whole packets are dropped."""
        if self._link.pending:
            self.dropped += 1
        else:
            self._link.send(self._packet.pack(self._machine.outputs))

    def hung_up(self) -> None:
        """See `Session`."""
