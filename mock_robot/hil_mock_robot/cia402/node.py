"""CANopen node of one mock drive: SDO, NMT, EMCY, heartbeat and PDOs, on live registers.

`MockNode` receives frames and device time, and notifies its drive by `Hooks`. `MockNode` is based
on `canopen.LocalNode` without the threads and clocks of that library: `DeviceNetwork` replaces its
bus, `NmtSlave` adds the resets, `Producer` and `Consumer` count heartbeats in device time.

| NMT state    | event                                         | next state      |
|--------------|-----------------------------------------------|-----------------|
| initialising | `boot_s` is over: the boot-up message is sent | pre-operational |
| any other    | start (1)                                     | operational     |
| any other    | stop (2)                                      | stopped         |
| any other    | enter pre-operational (128)                   | pre-operational |
| any other    | reset node (129), reset communication (130)   | initialising    |
| operational  | connection lost, 1029h:1 = 0                  | pre-operational |
| operational  | connection lost, 1029h:1 = 2                  | stopped         |
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Never

import canopen
from canopen import nmt
from canopen.network import Network

from hil_mock_robot.cia402 import access_rules, keys
from hil_mock_robot.cia402.access_rules import (
    CAN_ID,
    CONSUMERS,
    DEVICE_STATE,
    cob_id_is_valid,
    require,
    watched,
)
from hil_mock_robot.cia402.bus import Send
from hil_mock_robot.cia402.dictionary import (
    HISTORY,
    N_CONSUMED,
    Object,
    by_key,
    eds_of,
    object_dictionary,
)
from hil_mock_robot.cia402.keys import Registers, key
from hil_mock_robot.cia402.pdo import TIMED_OUT, TOO_LONG, TOO_SHORT, Exchange
from hil_mock_robot.cia402.sdo import SdoServer

HEARTBEAT = 0x700
HEARTBEAT_LOST, BUS_OFF = 0x8130, 0x8140
SDO_BYTES = 8


class NmtState(IntEnum):
    """NMT state of a node; the value of each member is the value in a heartbeat."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


BOOT_UP = bytes([NmtState.INITIALISING])

TALKING = (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
"""NMT states in which a node serves SDO and sends EMCY."""

REACTIONS = {0: NmtState.PRE_OPERATIONAL, 2: NmtState.STOPPED}
"""NMT state after a communication error in the state operational, by the value of 1029h:1."""

FIELD = 0x1003
_ERROR_STATE = (0x1001, FIELD, 0x603F)
_DRIVE_FAULT, _FAULT_MASK = 0x08, 0x4F


class MockNode(canopen.LocalNode):
    """CANopen node of one drive, to which the caller passes frames and device time.

    Args:
        node_id: Node id, 1 to 127.
        registers: Live registers from `dictionary.registers_of`, shared with the drive.
        send: Function that puts a frame on the bus.
        hooks: Callbacks to the drive of this node.
        boot_s: Duration of a start in device time, during which the node ignores all frames [s].

    Attributes:
        node_id: Node id.
        registers: Live registers, shared with the drive.
        hooks: Callbacks to the drive of this node.
        errors: List of the present and earlier errors of the node.
    """

    def __init__(
        self,
        node_id: int,
        registers: Registers,
        send: Send,
        hooks: Hooks | None = None,
        boot_s: float = 0.0,
    ) -> None:
        super().__init__(node_id, object_dictionary(node_id, registers))
        relative = (entry.key for entry in by_key().values() if entry.node_relative)
        registers.update({where: registers[where] + node_id for where in relative})
        self.node_id, self.registers, self.hooks = node_id, registers, hooks or Hooks()
        self._defaults = dict(registers)
        self._send, self._boot_s, self._now_s = send, boot_s, 0.0
        self._booted_s: float | None = None
        self._eds = b""
        self.nmt = self._nmt = NmtSlave(node_id, self._nmt_changed, self._reset)
        self.errors = Errors(registers, self._send_emergency)
        self._exchange = Exchange(registers, send, lambda: self.hooks.applied())
        self._producer = Producer(registers)
        self._consumer = Consumer(registers)
        self.sdo = SdoServer(self, node_id)
        self._bus = DeviceNetwork(send)
        self.associate_network(self._bus)

    def boot(self) -> None:
        """Switch the node on: after `boot_s`, send the boot-up and enter pre-operational."""
        self._nmt.start()
        self._booted_s = self._now_s + self._boot_s
        if not self._boot_s:
            self._booted()

    def heard(self, can_id: int, data: bytes) -> None:
        """Handle a received frame except SYNC; the node's own frames must not be passed."""
        state = self._nmt.code
        if state is NmtState.INITIALISING:
            return
        if self._exchange.receives(can_id):
            if state is NmtState.OPERATIONAL:
                self._heard_rpdo(can_id, data)
        elif can_id > HEARTBEAT:
            self._heard_heartbeat(can_id - HEARTBEAT)
        elif can_id == 0 or (state in TALKING and len(data) == SDO_BYTES):
            self._bus.heard(can_id, data)

    def synced(self) -> None:
        """Handle SYNC: apply the RPDOs received before the SYNC, and send TPDOs."""
        if self._nmt.code is NmtState.OPERATIONAL:
            self._exchange.synced()

    def ticked(self, device_s: float) -> None:
        """Advance the node to a device time [s]: send and check heartbeats, check event timers."""
        self._now_s = device_s
        if self._nmt.code is NmtState.INITIALISING:
            if self._booted_s is not None and device_s >= self._booted_s:
                self._booted()
            return
        for _ in self._consumer.overdue(device_s):
            self._lost_connection(HEARTBEAT_LOST)
        if self._nmt.code is NmtState.OPERATIONAL and self._exchange.ticked(device_s):
            self._lost_connection(TIMED_OUT)
        if self._producer.due(device_s):
            self._send(HEARTBEAT + self.node_id, bytes([self._nmt.code]))

    def emergency(self, code: int, register: int | None = None, data: bytes = b"") -> None:
        """Report an error by EMCY, 603Fh, 1001h, 1003h; an error already present is ignored.

        Args:
            code: Error code; 0 to report that all errors are gone.
            register: Bits of the error in 1001h; None for the bits that belong to the error code.
            data: Up to five bytes of manufacturer data.
        """
        if code:
            self.errors.report(code, register, data)
        else:
            self.errors.recovered()

    def recovered(self, code: int | None = None) -> None:
        """Report by EMCY 0000h that an error is gone, or for None that all errors are gone."""
        self.errors.recovered(code)

    @property
    def missed(self) -> int:
        """Number of consecutive SYNCs without a set-point, if RPDOs contain set-points."""
        return self._exchange.missed

    def bus_off(self) -> None:
        """Simulate bus-off of the CAN controller, to which the drive reacts."""
        self._react(BUS_OFF)

    def bus_back(self) -> None:
        """Return from bus-off and report the bus-off as an error."""
        self.errors.told_late(BUS_OFF)

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """Return an object's data; called by the SDO server."""
        entry = access_rules.entry_of(index, subindex)
        if entry.type == "domain":
            self._eds = self._eds or eds_of(self.object_dictionary)
            return self._eds
        return access_rules.read_object(self.registers, entry, by_client=check_readable)

    def set_data(
        self, index: int, subindex: int, data: bytes, check_writable: bool = False
    ) -> None:
        """Write an object for a client; called by the SDO server."""
        entry = access_rules.entry_of(index, subindex)
        layout = access_rules.is_pdo_object(index)
        value = access_rules.decoded_value(
            self.registers, entry, bytes(data), by_client=check_writable
        )
        require(not layout or self._nmt.code is not NmtState.OPERATIONAL, DEVICE_STATE)
        self.registers[entry.key] = value
        self._follow(entry, value)
        self.hooks.written(entry.key, value)

    def _follow(self, entry: Object, value: int) -> None:
        """React to a write of an object that configures the node."""
        if access_rules.is_pdo_object(entry.index):
            self._exchange.configure()
        elif entry.index == access_rules.CONSUMERS:
            self._consumer.configure()
        elif entry.key == keys.PRODUCER_HEARTBEAT:
            self._producer.restart(self._now_s)
        elif entry.index == FIELD:
            self.errors.clear_history()
        elif entry.key == keys.TARGET_POSITION:
            self._exchange.lead_by_hand()
        elif entry.key == keys.SIMULATED_ERROR:
            self.emergency(value)

    def _booted(self) -> None:
        self._booted_s = None
        self._send(HEARTBEAT + self.node_id, BOOT_UP)
        self._nmt.enter(NmtState.PRE_OPERATIONAL)
        self._producer.restart(self._now_s + self.registers[keys.PRODUCER_HEARTBEAT] / 1000)

    def _reset(self, application: bool) -> None:
        self.hooks.resetting(application)
        for entry in by_key().values():
            communication = 0x1000 <= entry.index < 0x2000
            stays = entry.stays or entry.index in _ERROR_STATE
            if entry.key in self._defaults and not stays and (application or communication):
                self.registers[entry.key] = self._defaults[entry.key]
        if application:
            self.errors.forget()
        self._exchange.configure()
        self._consumer.configure()
        self.hooks.booted(application)
        self.boot()

    def _nmt_changed(self, state: NmtState) -> None:
        if state is NmtState.OPERATIONAL:
            self._exchange.restart()
        self.hooks.nmt_changed(state)

    def _heard_rpdo(self, can_id: int, data: bytes) -> None:
        wrong = self._exchange.heard(can_id, data, self._now_s)
        for code in (TOO_SHORT, TOO_LONG):
            if code == wrong:
                self.errors.report(code)
            elif code in self.errors.active:
                self.errors.recovered(code)

    def _heard_heartbeat(self, node: int) -> None:
        back = self._consumer.heard(node, self._now_s)
        if back and self.registers[keys.STATUSWORD] & _FAULT_MASK != _DRIVE_FAULT:
            self.errors.recovered(HEARTBEAT_LOST)

    def _lost_connection(self, code: int) -> None:
        self.errors.report(code)
        self._react(code)

    def _react(self, code: int) -> None:
        self.hooks.connection_lost(code)
        reaction = REACTIONS.get(self.registers[keys.COMMUNICATION_ERROR_REACTION])
        if reaction is not None and self._nmt.code is NmtState.OPERATIONAL:
            self._nmt.enter(reaction)

    def _send_emergency(self, message: bytes) -> None:
        cob_id = self.registers[key(access_rules.EMERGENCY_COB_ID)]
        if self._nmt.code in TALKING and cob_id_is_valid(cob_id):
            self._send(cob_id & CAN_ID, message)


def _nothing(*_: object) -> None:
    """Ignore the call; this function is the default of all callbacks."""


@dataclass(slots=True)
class Hooks:
    """Callbacks from a node to its owner, called within `heard`, `synced` or `ticked`.

    Attributes:
        applied: Called after controlword and set-points of RPDOs were written into the registers.
        written: Called after an SDO client has written an object, with its key and new raw value.
        resetting: Called before the node resets, while its state is unchanged; the argument is True
            for reset node, False for reset communication.
        nmt_changed: Called with the new NMT state (`NmtState`).
        booted: Called after the reset of the node, with the same argument as `resetting`.
        connection_lost: Called with the error code (8130h, 8140h or 8250h) of a lost connection;
            the drive reacts as 6007h requires.
    """

    applied: Callable[[], None] = _nothing
    written: Callable[[int, int], None] = _nothing
    resetting: Callable[[bool], None] = _nothing
    nmt_changed: Callable[[int], None] = _nothing
    booted: Callable[[bool], None] = _nothing
    connection_lost: Callable[[int], None] = _nothing


START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
"""NMT commands."""

TARGETS = {
    START: NmtState.OPERATIONAL,
    STOP: NmtState.STOPPED,
    ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
}

ALL_NODES = 0
_STATES = {int(state): state for state in NmtState}


class NmtSlave(nmt.NmtSlave):
    """NMT state machine with a callback for every change.

    `NmtSlave` replaces the NMT class of `canopen`, which supports neither resets nor a device
    clock. The library's property `state` reads and sets the state by name.

    Args:
        node_id: Node id, by which commands for this node are recognized.
        changed: Callback for a new NMT state.
        reset: Callback for a reset; True for reset node, False for reset communication.
    """

    def __init__(
        self, node_id: int, changed: Callable[[NmtState], None], reset: Callable[[bool], None]
    ) -> None:
        super().__init__(node_id, None)
        self._changed, self._reset = changed, reset

    @property
    def code(self) -> NmtState:
        """Present state as `NmtState`."""
        return _STATES[self._state]

    def on_command(self, can_id: int, data: bytes, timestamp: float) -> None:
        """Handle an NMT frame from the bus, which contains a command and a node id."""
        if len(data) == 2 and data[1] in (ALL_NODES, self.id):
            self.send_command(data[0])

    def send_command(self, code: int) -> None:
        """Execute an NMT command; ignore unknown commands, and all commands during the start."""
        if self.code is NmtState.INITIALISING:
            return
        if code in (RESET_NODE, RESET_COMMUNICATION):
            self._reset(code == RESET_NODE)
        elif code in TARGETS:
            self.enter(TARGETS[code])

    def start(self) -> None:
        """Enter the NMT state initialising after power on or reset."""
        self._state = int(NmtState.INITIALISING)

    def enter(self, state: NmtState) -> None:
        """Enter an NMT state and call the callback if the state changes."""
        if state is not self.code:
            self._state = int(state)
            self._changed(state)


TOLERANCE_S = 1e-9


class Producer:
    """Schedule of the node's own heartbeat.

    Args:
        registers: Live objects of the drive.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._next_s = 0.0

    def restart(self, now_s: float) -> None:
        """Restart the schedule with a new period; the first heartbeat is due at `now_s`."""
        self._next_s = now_s

    def due(self, now_s: float) -> bool:
        """Return whether the heartbeat must be sent now; called once a tick."""
        period_s = self._registers[keys.PRODUCER_HEARTBEAT] / 1000
        if not period_s or now_s + TOLERANCE_S < self._next_s:
            return False
        self._next_s = max(self._next_s, now_s - period_s) + period_s
        return True


class Consumer:
    """Monitor of other nodes' heartbeats, which begins with the first heartbeat of each node.

    Args:
        registers: Live objects of the drive.
    """

    def __init__(self, registers: Registers) -> None:
        self._registers = registers
        self._timeouts: dict[int, float] = {}
        self._heard: dict[int, float] = {}
        self._lost: set[int] = set()

    def configure(self) -> None:
        """Read the object 1016h again and wait for the first heartbeat of each monitored node."""
        entries = (
            watched(self._registers[key(CONSUMERS, n)]) for n in range(1, N_CONSUMED + 1)
        )  # fmt: skip
        self._timeouts = {node: timeout_s for node, timeout_s in entries if timeout_s}
        self._heard.clear()
        self._lost.clear()

    def heard(self, node: int, now_s: float) -> bool:
        """Record a heartbeat; return True if no node is lost any more because of this heartbeat."""
        if node not in self._timeouts:
            return False
        self._heard[node] = now_s
        if node not in self._lost:
            return False
        self._lost.remove(node)
        return not self._lost

    def overdue(self, now_s: float) -> list[int]:
        """Return the ids of the nodes that were lost since the last call."""
        lost = [
            node
            for node, heard_s in self._heard.items()
            if now_s - heard_s > self._timeouts[node] + TOLERANCE_S and node not in self._lost
        ]
        self._lost.update(lost)
        return lost


MESSAGE = struct.Struct("<HB5s")

GENERIC, CURRENT, VOLTAGE, TEMPERATURE, COMMUNICATION, PROFILE, MAKER = (
    1 << bit for bit in (0, 1, 2, 3, 4, 5, 7)
)
"""Bits of the error register (1001h)."""

_COMMUNICATION = (0x81, 0x82)

_GROUPS = {
    0x2: CURRENT, 0x3: VOLTAGE, 0x4: TEMPERATURE, 0x7: PROFILE, 0x8: PROFILE, 0xF: MAKER,
}  # fmt: skip


def bits_of(code: int) -> int:
    """Return the bits of 1001h for an error code (CiA 301; CiA 402 for 7xxxh and from 83xxh)."""
    if code >> 8 in _COMMUNICATION:
        return GENERIC | COMMUNICATION
    return GENERIC | _GROUPS.get(code >> 12, 0)


class Errors:
    """List of the present and earlier errors of a node.

    Args:
        registers: Live objects of the drive.
        send: Function that puts the eight bytes of an EMCY message on the bus, if the NMT state
            permits EMCY.
    """

    def __init__(self, registers: Registers, send: Callable[[bytes], None]) -> None:
        self._registers, self._send = registers, send
        self._active: dict[int, int] = {}

    @property
    def active(self) -> tuple[int, ...]:
        """Codes of the present errors, in the order of their occurrence."""
        return tuple(self._active)

    def report(self, code: int, register: int | None = None, data: bytes = b"") -> None:
        """Add an error; an error already present is not reported again.

        Args:
            code: Error code.
            register: Bits of the error in 1001h; None for the bits that belong to the error code.
            data: Up to five bytes of manufacturer data.
        """
        if code in self._active:
            return
        self._active[code] = bits_of(code) if register is None else register | GENERIC
        self._remember(code)
        self._registers[keys.ERROR_CODE] = code
        self._send_emergency(code, data)

    def recovered(self, code: int | None = None) -> None:
        """Remove an error, or for None all errors, and report the removal."""
        if code is None:
            gone = bool(self._active)
            self._active.clear()
        else:
            gone = self._active.pop(code, None) is not None
        if gone:
            self._send_emergency(0, b"")

    def told_late(self, code: int) -> None:
        """Report an error that occurred while the node was off the bus.

        An error that is no longer present is reported by two messages: occurred and gone.
        """
        if code in self._active:
            self._send_emergency(code, b"")
        else:
            self.report(code)
            self.recovered(code)

    def forget(self) -> None:
        """Clear all errors, as power off and on does."""
        self._active.clear()
        self._registers[keys.ERROR_REGISTER] = self._registers[keys.ERROR_CODE] = 0
        self.clear_history()

    def clear_history(self) -> None:
        """Clear the error list (1003h)."""
        for sub in range(HISTORY + 1):
            self._registers[key(FIELD, sub)] = 0

    def _remember(self, code: int) -> None:
        registers = self._registers
        for sub in range(HISTORY, 1, -1):
            registers[key(FIELD, sub)] = registers[key(FIELD, sub - 1)]
        registers[key(FIELD, 1)] = code
        registers[key(FIELD)] = min(HISTORY, registers[key(FIELD)] + 1)

    def _send_emergency(self, code: int, data: bytes) -> None:
        register = 0
        for bits in self._active.values():
            register |= bits
        self._registers[keys.ERROR_REGISTER] = register
        self._send(MESSAGE.pack(code, register, data))


Heard = Callable[[int, Any, float], None]


class DeviceNetwork(Network):
    """Network object of the library `canopen` for one node, without a bus.

    Args:
        send: Function that puts a frame on the bus.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._listeners: dict[int, list[Heard]] = {}
        super().__init__()

    def subscribe(self, can_id: int, callback: Heard) -> None:
        """Add a callback for every frame with an identifier."""
        self._listeners.setdefault(can_id, []).append(callback)

    def unsubscribe(self, can_id: int, callback: Heard | None = None) -> None:
        """Remove a callback of an identifier, or for None all callbacks of the identifier."""
        if callback is None:
            self._listeners.pop(can_id, None)
        elif callback in self._listeners.get(can_id, []):
            self._listeners[can_id].remove(callback)

    def send_message(self, can_id: int, data: Iterable[int], remote: bool = False) -> None:
        """Put a frame on the bus immediately."""
        self._send(can_id, bytes(data))

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Never:
        """Raise `NotImplementedError`, because all periodic frames use the device clock."""
        raise NotImplementedError("the mock node sends nothing by a timer of its own")

    def heard(self, can_id: int, data: bytes) -> None:
        """Pass a received frame to all callbacks of its identifier."""
        for callback in self._listeners.get(can_id, ()):
            callback(can_id, data, 0.0)
