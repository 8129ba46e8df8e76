"""The same cycle through canopen's PdoMaps: as quick as that way can be made, and as documented.

Deadlines, priorities and timers are ours (`Schedule`, `realtime`; its Notifier thread inherits
them). Nothing is judged, answers are kept as they are decoded.
`python -m benchmarks.can_bus.pdo_maps CHANNEL|virtual RATE_HZ SECONDS [documented] [ordinary]`
prints its figures; on `virtual` those of both ends, with LocalNodes as drives.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import canopen

from benchmarks.can_bus.drives import NODES
from benchmarks.can_bus.local_nodes import Drive
from benchmarks.can_bus.maps import dictionary, lay_out
from benchmarks.can_bus.timing import SETTLE_S, Stretch, Times, swing, tell
from hil_drivers.cia402.axis import ENABLE
from hil_drivers.cia402.can_channel import rpdo_cob_id, tpdo_cob_id
from hil_drivers.cia402.mapping import POSITION
from hil_drivers.cia402.objects import CSP
from hil_drivers.cia402.timing import realtime


class Master:
    """Remote nodes, their PDO maps, and the cycle, as quick as can be.

    Objects are looked up once, a set-point is one value a map, answers are decoded in one go when
    a lock says that all have come.

    Args:
        network: Connected.
    """

    def __init__(self, network: Any) -> None:
        self._network, self._left = network, 0
        self._all_came = threading.Lock()
        self._all_came.acquire()
        nodes = [canopen.RemoteNode(node, dictionary()) for node in NODES]
        for node in nodes:
            network.add_node(node)
        self._nodes = nodes
        self._commands = [lay_out(node.rpdo[1], POSITION.rpdos[0], rpdo_cob_id) for node in nodes]
        answers = [
            lay_out(node.tpdo[pdo.number], pdo, tpdo_cob_id)
            for pdo in POSITION.tpdos
            for node in nodes
        ]
        self._number = len(answers)
        for answer in answers:
            answer.subscribe()
            answer.add_callback(self._came)
        self._values = [variable for answer in answers for variable in answer.map]
        self._targets = [command["target_position"] for command in self._commands]
        for command in self._commands:
            command["controlword"].raw, command["mode"].raw = ENABLE, CSP

    def cycle(self, row: list[int], times: Times) -> list[int]:
        """SYNC, set-points, answers; decoded as far as they have come."""
        self._all_came.acquire(blocking=False)
        self._left = self._number
        synced = time.monotonic()
        self._network.sync.transmit()
        for target, command, value in zip(self._targets, self._commands, row, strict=True):
            target.raw = value
            command.transmit()
        patience_s = max(times.give_up - time.monotonic(), 0.0)
        times.complete = self._all_came.acquire(timeout=patience_s)
        values = [variable.raw for variable in self._values]
        times.answering.add(time.monotonic() - synced)
        return values

    def _came(self, answer: Any) -> None:
        self._left -= 1
        if not self._left and self._all_came.locked():  # else it is a late one
            self._all_came.release()


class DocumentedMaster(Master):
    """As canopen's documentation has it: objects by name, answers decoded as they are heard."""

    def cycle(self, row: list[int], times: Times) -> list[int]:
        """See `Master`."""
        self._all_came.acquire(blocking=False)
        self._left, self._heard = self._number, dict[int, dict[str, int]]()
        synced = time.monotonic()
        self._network.sync.transmit()
        for node, value in zip(self._nodes, row, strict=True):
            command = node.rpdo[1]
            command["controlword"].raw = ENABLE
            command["mode"].raw = CSP
            command["target_position"].raw = value
            command.transmit()
        patience_s = max(times.give_up - time.monotonic(), 0.0)
        times.complete = self._all_came.acquire(timeout=patience_s)
        times.answering.add(time.monotonic() - synced)
        return [value for each in list(self._heard.values()) for value in each.values()]

    def _came(self, answer: Any) -> None:
        self._heard[answer.cob_id] = {variable.name: variable.raw for variable in answer}
        super()._came(answer)


def measure(channel: str, rate_hz: float, seconds: float) -> dict[str, float]:
    """Play a motion; what it took."""
    rows = swing(rate_hz, SETTLE_S + seconds, len(NODES)).tolist()
    settled = round(SETTLE_S * rate_hz)
    with realtime() as refused, _network(channel) as network:
        kind = DocumentedMaster if "documented" in sys.argv else Master
        master, times = kind(network), Times(1.0 / rate_hz)
        kept, stretch = [], Stretch(times)
        times.restart()
        for number, row in enumerate(rows):
            if number == settled:
                stretch = Stretch(times)
            times.wait(_sleep_until)
            kept.append(master.cycle(row, times))
            times.done()
        figures = stretch.figures()
    return figures | {"records": float(len(kept) - settled), "fifo": float(not refused)}


def _sleep_until(until_s: float) -> None:
    left_s = until_s - time.monotonic()
    if left_s > 0:
        time.sleep(left_s)


@contextmanager
def _network(channel: str) -> Iterator[Any]:
    """Open the network of the master; on `virtual`, the drives are in this process."""
    with ExitStack() as stack:
        interface = "virtual" if channel == "virtual" else "hil_unix"
        if interface == "virtual":
            drives = stack.enter_context(_connected(interface, channel))
            for node_id in NODES:
                Drive(drives, node_id)
        yield stack.enter_context(_connected(interface, channel))


@contextmanager
def _connected(interface: str, channel: str) -> Iterator[Any]:
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.1
    network.connect(interface=interface, channel=channel)
    yield network
    network.disconnect()


if __name__ == "__main__":
    tell(measure)
