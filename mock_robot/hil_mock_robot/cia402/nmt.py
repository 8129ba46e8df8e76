"""NMT slave of CiA 301: boot-up, pre-operational, operational, stopped, and the two resets."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from canopen import nmt


class State(IntEnum):
    """As it is in a heartbeat."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
"""Commands."""

TARGETS = {
    START: State.OPERATIONAL,
    STOP: State.STOPPED,
    ENTER_PRE_OPERATIONAL: State.PRE_OPERATIONAL,
}
ALL_NODES = 0
_STATES = {int(state): state for state in State}


class NmtSlave(nmt.NmtSlave):
    """The state machine alone; what follows from it is told to who owns it.

    In place of `canopen`'s own, which knows neither resets nor a clock of the device's. The state
    by name, and set by name, is the library's property `state`.

    Args:
        node_id: Which commands are for it.
        changed: Called with a new state.
        reset: Called when the node has to start anew; True where its application has, too.
    """

    def __init__(
        self, node_id: int, changed: Callable[[State], None], reset: Callable[[bool], None]
    ) -> None:
        super().__init__(node_id, None)
        self._changed, self._reset = changed, reset

    @property
    def code(self) -> State:
        """The state."""
        return _STATES[self._state]

    def on_command(self, can_id: int, data: bytes, timestamp: float) -> None:
        """An NMT command was on the bus: command, node."""
        if len(data) == 2 and data[1] in (ALL_NODES, self.id):
            self.send_command(data[0])

    def send_command(self, code: int) -> None:
        """Do as the NMT master says; unknown commands are passed over, and all while booting."""
        if self.code is State.INITIALISING:
            return
        if code in (RESET_NODE, RESET_COMMUNICATION):
            self._reset(code == RESET_NODE)
        elif code in TARGETS:
            self.enter(TARGETS[code])

    def start(self) -> None:
        """Switched on, or reset: it is initialising."""
        self._state = int(State.INITIALISING)

    def enter(self, state: State) -> None:
        """Be in this state from now on."""
        if state is not self.code:
            self._state = int(state)
            self._changed(state)
