"""One drive as a CANopen node: SDO, NMT, EMCY, heartbeat and PDOs on its live registers."""

from __future__ import annotations

import canopen

from hil_mock_robot.cia402 import access, errors, heartbeat, keys, pdo_rules
from hil_mock_robot.cia402.aborts import DEVICE_STATE, require
from hil_mock_robot.cia402.cob_ids import CAN_ID, valid
from hil_mock_robot.cia402.contracts import Registers, Send, key
from hil_mock_robot.cia402.dictionary import by_key
from hil_mock_robot.cia402.eds import eds_of, object_dictionary
from hil_mock_robot.cia402.exchange import TIMED_OUT, TOO_LONG, TOO_SHORT, Exchange
from hil_mock_robot.cia402.hooks import Hooks
from hil_mock_robot.cia402.network import DeviceNetwork
from hil_mock_robot.cia402.nmt import NmtSlave, State
from hil_mock_robot.cia402.objects import Object
from hil_mock_robot.cia402.sdo import SdoServer

HEARTBEAT = 0x700
HEARTBEAT_LOST, BUS_OFF = 0x8130, 0x8140
SDO_BYTES = 8
BOOT_UP = bytes([State.INITIALISING])
TALKING = (State.PRE_OPERATIONAL, State.OPERATIONAL)
"""States with SDO and EMCY."""

REACTIONS = {0: State.PRE_OPERATIONAL, 2: State.STOPPED}
"""What 1029h:1 says to become when communication fails while operational."""

_ERROR_STATE = (0x1001, errors.FIELD, 0x603F)
_DRIVE_FAULT, _FAULT_MASK = 0x08, 0x4F


class MockNode(canopen.LocalNode):
    """Implements `contracts.Node`.

    Args:
        node_id: 1 to 127.
        registers: What `dictionary.registers_of` returned; live, shared with the drive.
        send: Puts a frame on the bus.
        hooks: What the drive behind it wants to be told.
        boot_s: Device time that a start takes, in which it is deaf.

    Attributes:
        node_id, registers, hooks: As given.
        errors: What is wrong.
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
        self.errors = errors.Errors(registers, self._send_emergency)
        self._exchange = Exchange(registers, send, lambda: self.hooks.applied())
        self._producer = heartbeat.Producer(registers)
        self._consumer = heartbeat.Consumer(registers)
        self.sdo = SdoServer(self, node_id)
        self._bus = DeviceNetwork(send)
        self.associate_network(self._bus)

    def boot(self) -> None:
        """Power on: after `boot_s` the boot-up message, then pre-operational."""
        self._nmt.start()
        self._booted_s = self._now_s + self._boot_s
        if not self._boot_s:
            self._booted()

    def heard(self, can_id: int, data: bytes) -> None:
        """A frame was on the bus (not one of its own); SYNC comes separately."""
        state = self._nmt.code
        if state is State.INITIALISING:
            return
        if self._exchange.receives(can_id):
            if state is State.OPERATIONAL:
                self._heard_rpdo(can_id, data)
        elif can_id > HEARTBEAT:
            self._heard_heartbeat(can_id - HEARTBEAT)
        elif can_id == 0 or (state in TALKING and len(data) == SDO_BYTES):
            self._bus.heard(can_id, data)

    def synced(self) -> None:
        """A SYNC was on the bus: RPDOs that came before it are applied, TPDOs are sent."""
        if self._nmt.code is State.OPERATIONAL:
            self._exchange.synced()

    def ticked(self, device_s: float) -> None:
        """Time has passed: heartbeats, event timers, consumers' watch."""
        self._now_s = device_s
        if self._nmt.code is State.INITIALISING:
            if self._booted_s is not None and device_s >= self._booted_s:
                self._booted()
            return
        for _ in self._consumer.overdue(device_s):
            self._lost_connection(HEARTBEAT_LOST)
        if self._nmt.code is State.OPERATIONAL and self._exchange.ticked(device_s):
            self._lost_connection(TIMED_OUT)
        if self._producer.due(device_s):
            self._send(HEARTBEAT + self.node_id, bytes([self._nmt.code]))

    def emergency(self, code: int, register: int | None = None, data: bytes = b"") -> None:
        """Report an error: EMCY, 603Fh, 1001h, 1003h; one that is there already is not new.

        Args:
            code: Error code; 0: nothing is wrong any more.
            register: What it sets in 1001h, by default what its code stands for.
            data: Up to five bytes of the maker's.
        """
        if code:
            self.errors.report(code, register, data)
        else:
            self.errors.recovered()

    def recovered(self, code: int | None = None) -> None:
        """That error is gone, or all are: EMCY 0000h."""
        self.errors.recovered(code)

    @property
    def missed(self) -> int:
        """SYNCs in a row without the set-point that an RPDO brings."""
        return self._exchange.missed

    def bus_off(self) -> None:
        """Its CAN controller has given up: nobody hears it, and it reacts."""
        self._react(BUS_OFF)

    def bus_back(self) -> None:
        """Its CAN controller is back: now it can say so."""
        self.errors.told_late(BUS_OFF)

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """An object's data; the SDO server's way in."""
        entry = access.entry_of(index, subindex)
        if entry.type == "domain":
            self._eds = self._eds or eds_of(self.object_dictionary)
            return self._eds
        return access.read(self.registers, entry, by_client=check_readable)

    def set_data(
        self, index: int, subindex: int, data: bytes, check_writable: bool = False
    ) -> None:
        """Write an object; the SDO server's way in."""
        entry = access.entry_of(index, subindex)
        layout = pdo_rules.concerns(index)
        value = access.decoded(self.registers, entry, bytes(data), by_client=check_writable)
        require(not layout or self._nmt.code is not State.OPERATIONAL, DEVICE_STATE)
        self.registers[entry.key] = value
        self._follow(entry, value)
        self.hooks.written(entry.key, value)

    def _follow(self, entry: Object, value: int) -> None:
        """What a write means for the node itself."""
        if pdo_rules.concerns(entry.index):
            self._exchange.configure()
        elif entry.index == heartbeat.CONSUMERS:
            self._consumer.configure()
        elif entry.key == keys.PRODUCER_HEARTBEAT:
            self._producer.restart(self._now_s)
        elif entry.index == errors.FIELD:
            self.errors.clear_history()
        elif entry.key == keys.TARGET_POSITION:
            self._exchange.lead_by_hand()
        elif entry.key == keys.SIMULATED_ERROR:
            self.emergency(value)

    def _booted(self) -> None:
        self._booted_s = None
        self._send(HEARTBEAT + self.node_id, BOOT_UP)
        self._nmt.enter(State.PRE_OPERATIONAL)
        self._producer.restart(self._now_s + self.registers[keys.PRODUCER_HEARTBEAT] / 1000)

    def _reset(self, application: bool) -> None:
        self.hooks.resetting(application)
        for entry in by_key().values():
            communication = 0x1000 <= entry.index < 0x2000
            stays = entry.kept or entry.index in _ERROR_STATE
            if entry.key in self._defaults and not stays and (application or communication):
                self.registers[entry.key] = self._defaults[entry.key]
        if application:
            self.errors.forget()
        self._exchange.configure()
        self._consumer.configure()
        self.hooks.booted(application)
        self.boot()

    def _nmt_changed(self, state: State) -> None:
        if state is State.OPERATIONAL:
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
        if reaction is not None and self._nmt.code is State.OPERATIONAL:
            self._nmt.enter(reaction)

    def _send_emergency(self, message: bytes) -> None:
        cob_id = self.registers[key(access.EMERGENCY_COB_ID)]
        if self._nmt.code in TALKING and valid(cob_id):
            self._send(cob_id & CAN_ID, message)
