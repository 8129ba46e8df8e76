"""Mock drives as their master sees them, without a bus: frames in and out, time by SYNC or own."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from hil_mock_robot.cia402.bus import ignored
from hil_mock_robot.cia402.mock import Mock
from hil_mock_robot.cia402.station import Unit
from hil_mock_robot.plant.truth import draw_truth

NMT, SYNC = 0x000, 0x080
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
BENT = (20.0, 30.0, -20.0, 40.0, 50.0, -30.0)
CSP, PP = 8, 1
RPDO = struct.Struct("<Hbi")
PERIOD_S = 0.004


class NoBus:
    """Takes what is sent; frames are put in by the test."""

    where = "no bus"

    def __init__(self) -> None:
        self.heard = ignored
        self.sent: list[tuple[int, bytes]] = []

    def send(self, can_id: int, data: bytes) -> None:
        assert 0 <= can_id <= 0x7FF
        assert len(data) <= 8
        self.sent.append((can_id, bytes(data)))

    def flush(self) -> None:
        """Nothing is kept."""

    def serve(self, timeout_s: float, others: object = ()) -> bool:
        return False

    def bus_off(self) -> None:
        """Nobody is there."""

    def recover(self) -> None:
        """Nobody is there."""

    def close(self) -> None:
        """Nothing to leave."""


class Desk:
    """Six drives of lab6 and a master at a desk: SDO, NMT, and process data to chosen nodes.

    Attributes:
        station: The drives.
        sent: Frames (COB-ID, data) of the drives.
    """

    def __init__(self, **options: Any) -> None:
        self._bus = NoBus()
        self.mock = Mock(draw_truth("lab6", 0, "full"), self._bus, start_q_deg=BENT, **options)
        self.mock.loop.close()  # frames are put in by hand
        self.station = self.mock.station
        self.station.boot()
        self._s = self.station.clock._own_s
        self.sent = self._bus.sent
        self.nodes = range(1, 7)

    def unit(self, node: int) -> Unit:
        return self.station.axes[node - 1]

    def state(self, node: int) -> str:
        return self.unit(node).drive.state.name

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.station.heard(can_id, data, self._s)

    def command(self, code: int, node: int = 0) -> None:
        """By NMT."""
        self.send(NMT, bytes([code, node]))

    def emergencies(self, node: int) -> list[int]:
        """Codes of its EMCY messages so far."""
        return [struct.unpack_from("<H", data)[0] for can_id, data in self.sent
                if can_id == 0x080 + node]  # fmt: skip

    def write(self, node: int, index: int, sub: int, code: str, value: int) -> int:
        """An expedited download; 0 or the abort code."""
        data = struct.pack("<" + code, value)
        head = struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, sub)
        return self._asked(node, head + data.ljust(4, b"\x00"))[0]

    def read(self, node: int, index: int, sub: int = 0) -> int:
        """An expedited upload, unsigned."""
        return self._asked(node, struct.pack("<BHB4x", 0x40, index, sub))[1]

    def read_registers(self, node: int, index: int, sub: int = 0) -> int:
        """Past the bus."""
        return self.unit(node).registers[index << 8 | sub]

    def _asked(self, node: int, request: bytes) -> tuple[int, int]:
        """Abort code and value."""
        before = len(self.sent)
        self.send(0x600 + node, request)
        answer = [data for can_id, data in self.sent[before:] if can_id == 0x580 + node][-1]
        value = int.from_bytes(answer[4:8], "little")
        if answer[0] == 0x80:
            return value, 0
        return 0, value & (1 << 8 * (4 - (answer[0] >> 2 & 3))) - 1

    def map(self, *nodes: int, type_: int = 1) -> None:
        """6040h, 6060h, 607Ah to these nodes (all without), 6041h back; then operational."""
        for node in nodes or self.nodes:
            self._map(node, 0x1400, 0x200 + node, (0x60400010, 0x60600008, 0x607A0020), type_)
            self._map(node, 0x1800, 0x180 + node, (0x60410010,), type_)
        self.command(START)

    def _map(
        self, node: int, index: int, cob_id: int, entries: tuple[int, ...], type_: int
    ) -> None:
        steps = [(index, 1, "I", cob_id | 1 << 31), (index + 0x200, 0, "B", 0)]
        steps += [(index + 0x200, sub, "I", entry) for sub, entry in enumerate(entries, 1)]
        steps += [(index + 0x200, 0, "B", len(entries)), (index, 2, "B", type_)]
        for step in (*steps, (index, 1, "I", cob_id)):
            assert self.write(node, *step) == 0, step

    def rpdo(self, node: int, word: int, target: int | None = None, mode: int = CSP) -> None:
        at = self.position(node) if target is None else target
        self.send(0x200 + node, RPDO.pack(word, mode, at))

    def position(self, node: int) -> int:
        return self.unit(node).registers[0x6064 << 8]

    def sync(self, count: int = 1) -> None:
        for _ in range(count):
            self.send(SYNC)
            self._s += PERIOD_S

    def wait(self, seconds: float) -> None:
        """Without SYNC."""
        for _ in range(round(seconds / 0.01)):
            self._s += 0.01
            self.station.lapsed(self._s)

    def enable(self, *nodes: int, mode: int = CSP) -> None:
        """These nodes (all without), where they are."""
        for word in (0x00, 0x06, 0x06, 0x07, 0x07, 0x0F, 0x0F):
            for node in nodes or self.nodes:
                self.rpdo(node, word, mode=mode)
            self.sync()
        assert all(self.state(node) == "OPERATION_ENABLED" for node in nodes or self.nodes)

    def turning(self, node: int, speed: float = 1.0, count: int = 60) -> int:
        """Enabled and sent along, up to a speed [rad/s]; the target that it was sent last."""
        counts = self.unit(node).drive._axis.counts
        target = float(self.position(node))
        for k in range(count):
            target += counts * speed * PERIOD_S * min(1.0, (k + 1) / 40)
            self.rpdo(node, 0x0F, round(target))
            self.sync()
        return round(target)

    @property
    def speed(self) -> np.ndarray:
        """(6,) true speed [rad/s]."""
        return np.array([seen.true_qd for seen in self.station.body.seen])
