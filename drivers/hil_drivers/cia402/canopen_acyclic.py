"""Objects of the drives by SDO, and their NMT states, through `canopen`.

The cyclic core owns the bus: it hands every frame that is no process data to `heard`, and what is
asked here goes out through the same bus. There is no second reader and no thread.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import canopen

from hil.core import CommandRefused, RobotTimeout
from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.aborts import Aborted
from hil_drivers.cia402.at_once import SDO_ANSWER, AtOnce
from hil_drivers.cia402.eds import dictionary_of, require_mappable
from hil_drivers.cia402.fed_network import FedNetwork, Send
from hil_drivers.cia402.mapping import Mapping
from hil_drivers.cia402.objects import Entry
from hil_drivers.cia402.pdo_mapping import lay_out

HEARTBEAT = 0x700
PREOPERATIONAL, OPERATIONAL = 0x7F, 0x05
_COMMANDS = {PREOPERATIONAL: 0x80, OPERATIONAL: 0x01}
_NAMES = {
    PREOPERATIONAL: "pre-operational",
    OPERATIONAL: "operational",
    0x04: "stopped",
    0: "booting",
}

ANSWER_S = 1.0
"""How long a drive may take to answer [s]; some need longer than the usual 0.3 s."""
TRIES = 2
PRODUCER_MS = 100
"""1017h: the drives' heartbeats."""
CONFIRM_S = 3.0
"""A drive that is told a state says by heartbeat within that time that it is there [s]."""

logging.getLogger("canopen").addHandler(logging.NullHandler())


class CanopenAcyclic:
    """Implements `hil_drivers.cia402.contracts.Acyclic`.

    Args:
        send: Puts a frame (COB-ID, data) on the bus; called by any thread. What it raises comes
            out of every method here.
        nodes: Node ids, in the order of the axes.
        names: Of the axes, for messages.
        eds: Per axis, path of its EDS file; may be empty.

    Attributes:
        at_once: Asks without waiting; by the thread that calls the rest.

    Raises:
        SpecError: An EDS file cannot be read.
    """

    def __init__(
        self, send: Send, nodes: Sequence[int], names: Sequence[str], eds: Sequence[str] = ()
    ) -> None:
        self.nodes, self._names, self._eds = tuple(nodes), tuple(names), tuple(eds)
        self._network, self.at_once = FedNetwork(send), AtOnce(send, nodes)
        self._dictionaries = [
            dictionary_of(p, n) for p, n in zip(self._eds, nodes, strict=bool(eds))
        ]
        self._remote = [self._added(axis) for axis in range(len(nodes))]
        self._locks = [threading.Lock() for _ in nodes]
        self._axes = {HEARTBEAT + node: axis for axis, node in enumerate(nodes)}
        self._answers = frozenset(SDO_ANSWER + node for node in nodes)
        self._told = threading.Condition()
        self._states: list[int | None] = [None] * len(nodes)

    def name_of(self, axis: int) -> str:
        """An axis for messages: joint and node."""
        return f"{self._names[axis]} (node {self.nodes[axis]})"

    def heard(self, can_id: int, data: bytes, time_s: float = 0.0) -> None:
        """A frame is on the bus; called by the cyclic thread, returns at once."""
        if can_id in self._answers and len(data) == 8:
            if not self.at_once.heard(can_id, data):
                self._network.notify(can_id, bytearray(data), time_s)
        elif can_id in self._axes and data:
            with self._told:
                self._states[self._axes[can_id]] = data[0]
                self._told.notify_all()

    def upload(self, axis: int, entry: Entry) -> int:
        """See `Acyclic`; a value shorter than the object is extended by its sign."""
        what = f"{entry} cannot be read"
        raw = self._asked(axis, entry, what, lambda sdo: sdo.upload(*_at(entry)))
        return int.from_bytes(raw[: entry.size], "little", signed=entry.code.islower())

    def download(self, axis: int, entry: Entry, value: int) -> None:
        """See `Acyclic`."""
        try:
            data = value.to_bytes(entry.size, "little", signed=entry.code.islower())
        except OverflowError:
            raise CommandRefused(
                f"{self.name_of(axis)}: {value} does not fit into {entry}"
            ) from None
        what = f"{entry} does not take {value}"
        self._asked(axis, entry, what, lambda sdo: sdo.download(*_at(entry), data))

    def preoperational(self) -> None:
        """See `Acyclic`; the drives' heartbeats are on from then on."""
        self._command(PREOPERATIONAL)
        for axis in range(len(self.nodes)):
            self.download(axis, od.PRODUCER_HEARTBEAT, PRODUCER_MS)
        self._confirm(PREOPERATIONAL)

    def operational(self) -> None:
        """See `Acyclic`; confirmed by the drives' heartbeats."""
        self._command(OPERATIONAL)
        self._confirm(OPERATIONAL)

    def released(self) -> None:
        """Send all drives to pre-operational without asking whether they got there."""
        self._command(PREOPERATIONAL)

    def map(self, mapping: Mapping) -> None:
        """See `Acyclic`.

        Raises:
            SpecError: An EDS file says that it cannot be.
        """
        for axis, dictionary in enumerate(self._dictionaries):
            require_mappable(dictionary, mapping, f"{self._eds[axis]}, {self.name_of(axis)}")
        for axis, node in enumerate(self.nodes):
            lay_out(self, axis, node, self.name_of(axis), mapping)

    def _added(self, axis: int) -> Any:
        dictionary: Any = self._dictionaries[axis] if self._dictionaries else None
        node = canopen.RemoteNode(self.nodes[axis], dictionary)
        node.sdo.RESPONSE_TIMEOUT = ANSWER_S
        return self._network.add_node(node)

    def _asked(self, axis: int, entry: Entry, what: str, ask: Callable[[Any], Any]) -> Any:
        """One request at a time per node, tried again when nobody answers."""
        self.at_once.forget(axis, entry)
        with self._locks[axis]:
            for _ in range(TRIES):
                try:
                    return ask(self._remote[axis].sdo)
                except canopen.SdoAbortedError as error:
                    raise Aborted(f"{self.name_of(axis)}: {what}", error.code) from error
                except canopen.SdoCommunicationError as error:
                    why = error
        raise RobotTimeout(
            f"{self.name_of(axis)}: {what}: {TRIES} times no answer in {ANSWER_S:g} s ({why})",
            hint="is the drive powered, is its node id right, and the bit rate of the bus?",
        )

    def _command(self, state: int) -> None:
        with self._told:
            self._states = [None] * len(self.nodes)
        for node in self.nodes:
            self._network.send_message(0, [_COMMANDS[state], node])

    def _confirm(self, state: int) -> None:
        until = time.monotonic() + CONFIRM_S
        with self._told:
            while any(told != state for told in self._states):
                left_s = until - time.monotonic()
                if left_s <= 0.0:
                    raise self._not_there(state)
                self._told.wait(left_s)

    def _not_there(self, state: int) -> RobotTimeout:
        late = [
            f"{self.name_of(axis)} {_said(told)}"
            for axis, told in enumerate(self._states)
            if told != state
        ]
        return RobotTimeout(
            f"not {_NAMES[state]} after {CONFIRM_S:g} s: {'; '.join(late)}",
            hint="switch the drives off and on again; look for another master on the bus",
        )


def _at(entry: Entry) -> tuple[int, int]:
    return entry.index, entry.sub


def _said(state: int | None) -> str:
    return "sends no heartbeat" if state is None else f"is {_NAMES.get(state, f'in state {state}')}"
