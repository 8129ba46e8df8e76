"""The same cycle through canopen's PdoMaps: as quick as that way can be made, and as documented.

Deadlines, priorities and timers are ours (`Schedule`, `realtime`; its Notifier thread inherits
them). Nothing is judged, answers are kept as they are decoded.
`python -m benchmarks.can_bus.pdo_maps CHANNEL|virtual RATE_HZ SECONDS [documented] [ordinary]`
prints its figures.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can
import canopen
from canopen.objectdictionary import datatypes

from benchmarks.can_bus.drives import NODES, Drives
from benchmarks.can_bus.timing import SETTLE_S, Stretch, Times, swing, tell
from hil.canbus.frame import Frame
from hil_drivers.cia402.mapping import POSITION, Pdo, rpdo_cob_id, tpdo_cob_id
from hil_drivers.cia402.objects import CSP, Entry
from hil_drivers.cia402.realtime import realtime
from hil_drivers.cia402.states import ENABLE

_TYPES = {
    "b": datatypes.INTEGER8,
    "h": datatypes.INTEGER16,
    "H": datatypes.UNSIGNED16,
    "i": datatypes.INTEGER32,
}


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
        nodes = [canopen.RemoteNode(node, _dictionary()) for node in NODES]
        for node in nodes:
            network.add_node(node)
        self._nodes = nodes
        self._commands = [self._map(node.rpdo[1], POSITION.rpdos[0], rpdo_cob_id) for node in nodes]
        answers = [
            self._map(node.tpdo[pdo.number], pdo, tpdo_cob_id)
            for pdo in POSITION.tpdos
            for node in nodes
        ]
        self._number = len(answers)
        for answer in answers:
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

    def _map(self, pdo_map: Any, pdo: Pdo, cob_id: Any) -> Any:
        pdo_map.clear()
        for entry in pdo.entries:
            pdo_map.add_variable(entry.index)
        pdo_map.cob_id = cob_id(pdo.number, pdo_map.pdo_node.node.id)
        pdo_map.enabled = True
        if cob_id is tpdo_cob_id:
            pdo_map.subscribe()
        return pdo_map


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
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.1
    if channel != "virtual":
        network.connect(interface="hil_unix", channel=channel)
        yield network
        network.disconnect()
        return
    over = threading.Event()
    answering = threading.Thread(target=_answer_on_virtual, args=(over,))
    answering.start()
    network.connect(interface="virtual", channel="hil-bench")
    yield network
    network.disconnect()
    over.set()
    answering.join()


def _answer_on_virtual(over: threading.Event) -> None:
    with can.Bus(interface="virtual", channel="hil-bench") as bus:

        def send(can_id: int, data: bytes) -> None:
            bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=data))

        drives = Drives(send)
        while not over.is_set():
            if (message := bus.recv(0.1)) is not None:
                drives.heard(Frame(message.arbitration_id, bytes(message.data)))


def _dictionary() -> Any:
    told: Any = canopen.objectdictionary.ObjectDictionary()  # type: ignore[no-untyped-call]
    for pdo in POSITION.pdos:
        for entry in pdo.entries:
            told.add_object(_variable(entry))
    for pdos, base in ((POSITION.rpdos, 0x1400), (POSITION.tpdos, 0x1800)):
        for pdo in pdos:
            for index in (base + pdo.number - 1, base + 0x200 + pdo.number - 1):
                told.add_object(canopen.objectdictionary.ODRecord(f"{index:04X}h", index))
    return told


def _variable(entry: Entry) -> Any:
    variable = canopen.objectdictionary.ODVariable(entry.name, entry.index, entry.sub)
    variable.data_type = _TYPES[entry.code]
    return variable


if __name__ == "__main__":
    tell(measure)
