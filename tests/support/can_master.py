"""A CANopen master for tests of the mock drives: SDO, NMT, SYNC and PDOs on any python-can bus.

Nothing of the driver is in it: the mock is judged by somebody else.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Sequence
from typing import Any

import can

N = 6
CSP = 8
RPDO1 = struct.Struct("<Hbi")
TPDO1 = struct.Struct("<Hib")
ANSWERS_S = 0.3
TPDO2 = struct.Struct("<ihh")


class Abort(Exception):
    """An SDO transfer was refused."""


class Master:
    """Talks to six drives, one request at a time.

    Attributes:
        status, position, mode: Per axis, from the TPDOs of the last cycle.
        emergencies: (node, code) of all that came.
        heartbeats: Node → states in the order in which they came.
    """

    def __init__(self, bus: can.BusABC, nodes: Sequence[int] = range(1, N + 1)) -> None:
        self.bus, self.nodes = bus, tuple(nodes)
        n = len(self.nodes)
        self.status, self.position, self.mode = [0] * n, [0] * n, [0] * n
        self.velocity, self.torque, self.current = [0] * n, [0] * n, [0] * n
        self.emergencies: list[tuple[int, int]] = []
        self.heartbeats: dict[int, list[int]] = {}
        self.answers: dict[int, bytes] = {}
        self.frames: list[can.Message] = []
        self.master_heartbeat = 0
        self.cycles = 0

    def send(self, can_id: int, data: bytes = b"") -> None:
        """One frame."""
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def hear(self, timeout_s: float = 0.0) -> can.Message | None:
        """One frame, noted for what it is."""
        message = self.bus.recv(timeout_s)
        if message is None or message.is_error_frame:
            return message
        self.frames.append(message)
        can_id, data = message.arbitration_id, bytes(message.data)
        node = can_id & 0x7F
        kind = can_id & ~0x7F
        if kind == 0x580:
            self.answers[node] = data
        elif kind == 0x080 and node:
            self.emergencies.append((node, struct.unpack_from("<H", data)[0]))
        elif kind == 0x700:
            self.heartbeats.setdefault(node, []).append(data[0])
        elif kind == 0x180 and node in self.nodes and len(data) == TPDO1.size:
            i = self.nodes.index(node)
            self.status[i], self.position[i], self.mode[i] = TPDO1.unpack(data)
        elif kind == 0x280 and node in self.nodes and len(data) == TPDO2.size:
            i = self.nodes.index(node)
            self.velocity[i], self.torque[i], self.current[i] = TPDO2.unpack(data)
        return message

    def _asked(self, node: int, request: bytes, within_s: float) -> bytes:
        self.answers.pop(node, None)
        self.send(0x600 + node, request)
        until = time.monotonic() + within_s
        while node not in self.answers:
            if time.monotonic() > until:
                raise TimeoutError(f"node {node} does not answer")
            self.hear(0.05)
        answer = self.answers.pop(node)
        if answer[0] == 0x80:
            raise Abort(f"{struct.unpack_from('<I', answer, 4)[0]:08X}")
        return answer

    def upload(self, node: int, index: int, sub: int = 0, within_s: float = 1.0) -> int:
        """An expedited upload, unsigned."""
        answer = self._asked(node, struct.pack("<BHB4x", 0x40, index, sub), within_s)
        size = 4 - (answer[0] >> 2 & 3)
        return int.from_bytes(answer[4 : 4 + size], "little")

    def download(self, node: int, index: int, sub: int, code: str, value: Any) -> None:
        """An expedited download."""
        data = struct.pack("<" + code, value)
        command = 0x23 | (4 - len(data)) << 2
        request = struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\x00")
        self._asked(node, request, 1.0)

    def nmt(self, command: int, node: int = 0) -> None:
        """An NMT command."""
        self.send(0x000, bytes([command, node]))

    def reset(self) -> None:
        """All drives start anew; waits until they have."""
        self.heartbeats.clear()
        self.nmt(0x81)
        until = time.monotonic() + 5.0
        while not all(0 in self.heartbeats.get(node, ()) for node in self.nodes):
            assert time.monotonic() < until, f"only {self.heartbeats} boot"
            self.hear(0.05)
        self.emergencies.clear()
        self.frames.clear()
        self.cycles = self.master_heartbeat = 0

    def map(self, period_ms: int = 4, heartbeat_ms: int = 0) -> None:
        """Lay out process data as the driver's mapping `position` has it, and go operational."""
        self.nmt(0x80)
        time.sleep(0.05)
        rpdo = (0x60400010, 0x60600008, 0x607A0020)
        tpdos = ((0x60410010, 0x60640020, 0x60610008), (0x606C0020, 0x60770010, 0x60780010))
        for node in self.nodes:
            self._map_one(node, 0x1400, 0x1600, 0x200, rpdo)
            for i, tpdo in enumerate(tpdos):
                self._map_one(node, 0x1800 + i, 0x1A00 + i, 0x180 + 0x100 * i, tpdo)
            self.download(node, 0x60C2, 1, "B", period_ms)
            self.download(node, 0x60C2, 2, "b", -3)
            if heartbeat_ms:
                self.download(node, 0x1016, 1, "I", 127 << 16 | heartbeat_ms)
        self.nmt(0x01)

    def _map_one(
        self, node: int, parameters: int, mapping: int, base: int, entries: Sequence[int]
    ) -> None:
        cob_id = base + node
        self.download(node, parameters, 1, "I", 0x8000_0000 | cob_id)
        self.download(node, mapping, 0, "B", 0)
        for sub, entry in enumerate(entries, 1):
            self.download(node, mapping, sub, "I", entry)
        self.download(node, mapping, 0, "B", len(entries))
        self.download(node, parameters, 2, "B", 1)
        self.download(node, parameters, 1, "I", cob_id)

    def marker(self, segment: int, status: int, master_id: int = 127) -> None:
        """Announce what it does."""
        self.send(0x180 + master_id, struct.pack("<iH", segment, status))

    def cycle(
        self,
        controlword: int,
        targets: Sequence[int],
        mode: int = CSP,
        within_s: float = ANSWERS_S,
    ) -> bool:
        """SYNC, commands, answers; whether all TPDOs came in time."""
        if self.master_heartbeat and self.cycles % self.master_heartbeat == 0:
            self.send(0x77F, b"\x05")
        self.cycles += 1
        self.send(0x080)
        for node, target in zip(self.nodes, targets, strict=True):
            self.send(0x200 + node, RPDO1.pack(controlword, mode, target))
        missing = {base + node for base in (0x180, 0x280) for node in self.nodes}
        until = time.monotonic() + within_s
        while missing and time.monotonic() < until:
            message = self.hear(0.05)
            if message is not None:
                missing.discard(message.arbitration_id)
        return not missing

    def enable(self, mode: int = CSP) -> list[int]:
        """Bring all axes to operation enabled where they are; returns where that is."""
        self.cycle(0x00, self.position, mode)
        for _ in range(3):
            self.cycle(0x00, self.position, mode)
        held = list(self.position)
        for controlword, state in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
            for _ in range(100):
                self.cycle(controlword, held, mode)
                if all(status & 0x6F == state for status in self.status):
                    break
            else:
                raise AssertionError(f"{controlword:02X}h: {[hex(s) for s in self.status]}")
        return held
