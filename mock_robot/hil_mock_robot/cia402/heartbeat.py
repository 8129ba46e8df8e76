"""Heartbeats by the device's clock: one's own (1017h), and those of others (1016h)."""

from __future__ import annotations

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.aborts import INCOMPATIBLE, require
from hil_mock_robot.cia402.communication_objects import N_CONSUMED
from hil_mock_robot.cia402.contracts import Registers, key

CONSUMERS = 0x1016
TOLERANCE_S = 1e-9


def watched(raw: int) -> tuple[int, float]:
    """Node and time-out [s] of an entry of 1016h; a time-out of 0: nobody is watched."""
    node, milliseconds = raw >> 16 & 0xFF, raw & 0xFFFF
    return node, milliseconds / 1000 if 0 < node < 128 else 0.0


def check_consumer(registers: Registers, sub: int, value: int) -> None:
    """A client sets an entry of 1016h.

    Raises:
        Abort: That node is watched by another entry.
    """
    others = (registers[key(CONSUMERS, n)] for n in range(1, N_CONSUMED + 1) if n != sub)
    nodes = {watched(raw)[0] for raw in others if watched(raw)[1]}
    require(not watched(value)[1] or watched(value)[0] not in nodes, INCOMPATIBLE)


class Producer:
    """Says when the node's own heartbeat is due.

    Args:
        registers: Live.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._next_s = 0.0

    def restart(self, now_s: float) -> None:
        """The period is new: the first one is due now."""
        self._next_s = now_s

    def due(self, now_s: float) -> bool:
        """Whether it has to be sent now; asked once a tick."""
        period_s = self._registers[keys.PRODUCER_HEARTBEAT] / 1000
        if not period_s or now_s + TOLERANCE_S < self._next_s:
            return False
        self._next_s = max(self._next_s, now_s - period_s) + period_s
        return True


class Consumer:
    """Watches other nodes' heartbeats, each from its first one on.

    Args:
        registers: Live.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._timeouts: dict[int, float] = {}
        self._heard: dict[int, float] = {}
        self._lost: set[int] = set()

    def configure(self) -> None:
        """Read 1016h anew; who is watched is waited for again."""
        entries = (
            watched(self._registers[key(CONSUMERS, n)]) for n in range(1, N_CONSUMED + 1)
        )  # fmt: skip
        self._timeouts = {node: timeout_s for node, timeout_s in entries if timeout_s}
        self._heard.clear()
        self._lost.clear()

    def heard(self, node: int, now_s: float) -> bool:
        """A heartbeat was on the bus; whether by it the last lost node is back."""
        if node not in self._timeouts:
            return False
        self._heard[node] = now_s
        if node not in self._lost:
            return False
        self._lost.remove(node)
        return not self._lost

    def overdue(self, now_s: float) -> list[int]:
        """Nodes that have been lost since it was last asked."""
        lost = [
            node
            for node, heard_s in self._heard.items()
            if now_s - heard_s > self._timeouts[node] + TOLERANCE_S and node not in self._lost
        ]
        self._lost.update(lost)
        return lost
