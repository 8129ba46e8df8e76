"""The power stage of one drive: its state, how it brings the axis to rest, when it lets go."""

from __future__ import annotations

import math
from collections.abc import Callable

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Axis
from hil_mock_robot.cia402.contracts import Demand
from hil_mock_robot.cia402.paths import Ramp, held
from hil_mock_robot.cia402.states import (
    HALT_BIT,
    POWERED,
    REMOTE,
    TARGET_REACHED,
    VOLTAGE_ENABLED,
    Command,
    State,
    Transition,
    command_of,
    commanded,
)
from hil_mock_robot.cia402.stopping import Stop, option_of

COASTING_STEPS = 50
"""How long a motor without current turns before the brake takes it."""

ENABLED = State.OPERATION_ENABLED
STAYS = 5
"""605Ah from here on: quick stop stays active when the axis rests."""

_OVERRIDING = (Transition.QUICK_STOP, Transition.DISABLE_FROM_ENABLED)
"""What does not wait for a ramp to end."""


class PowerStage:
    """The state machine at work on an axis.

    Args:
        axis: What it powers.
        begun: Called when the operation is enabled, and when it goes on after a quick stop.
        fault_reset: Called when a master resets a fault; whether it may, or its cause is there yet.

    Attributes:
        state: See `states`.
        powered: The motor may carry current.
        word: What the statusword says of the state.
        stop: What brings the axis to rest, as long as that takes (605Ah = 5 to 8: stays).
        halt: The same by bit 8 of the controlword.
        coasting: Steps for which the motor still turns without current.
    """

    def __init__(
        self, axis: Axis, begun: Callable[[], None], fault_reset: Callable[[], bool]
    ) -> None:
        self._axis, self._begun, self._fault_reset = axis, begun, fault_reset
        self.switch_off()

    def switch_off(self) -> None:
        """All is forgotten, the brake is closed."""
        self.stop: Stop | None = None
        self.halt: Ramp | None = None
        self.coasting = 0
        self._word, self._overruled = 0, -1
        self.enter(State.NOT_READY_TO_SWITCH_ON)

    @property
    def told(self) -> int:
        """What the statusword tells of the state; bit 10 while the axis is being stopped."""
        stop, halt = self.stop, self.halt
        rests = stop.rests if stop is not None else halt is not None and halt.done
        return self.word | TARGET_REACHED * rests

    def enter(self, state: State) -> None:
        """Be in a state."""
        self.state, self.powered, self._settled = state, state in POWERED, False
        self.word = state.value | REMOTE | VOLTAGE_ENABLED

    def obey(self) -> bool:
        """Act on the controlword as it stands; whether a halt has just ended."""
        word, before = self._axis.registers[keys.CONTROLWORD], self._word
        if word == before and self._settled:
            return False
        self._word, self._settled = word, True
        if word == self._overruled:
            return False
        self._overruled = -1
        self.command(command_of(word, before))
        return bool((word ^ before) & HALT_BIT) and self.state is ENABLED and self._turn_halt()

    def overrule(self, command: Command) -> None:
        """Command this in place of the controlword, which then counts only when it is another."""
        self.command(command)
        self._overruled = self._axis.registers[keys.CONTROLWORD]

    def command(self, command: Command) -> None:
        """Make the transition that it leads to, if any."""
        stays = option_of(self._axis.registers, keys.QUICK_STOP_OPTION) >= STAYS
        found = commanded(self.state, command, stays_stopped=stays)
        if found is None:
            return
        transition, to = found
        pending = self.stop is not None and self.state is ENABLED
        if not pending or transition in _OVERRIDING:
            self._settled = False
            self._make(transition, to)

    def react(self, keeps_torque: bool) -> None:
        """A fault: by 605Eh, from where the axis' set-point is, if it has torque to stop with."""
        option = option_of(self._axis.registers, keys.FAULT_REACTION_OPTION)
        if keeps_torque and option:
            self._begin_stop(option, State.FAULT)
        elif keeps_torque:
            self._lose(State.FAULT)
        else:
            self.enter(State.FAULT)

    def without(self, steps: int) -> Demand:
        """What the axis asks for without power: its motor turns freely, then the brake holds it."""
        rows = held(self._axis.q, steps)
        if self.coasting <= 0:
            return Demand(rows, math.nan, True)
        self.coasting -= steps
        return Demand(rows, 0.0, False)

    def look(self, qd: float, steps: int) -> None:
        """The joint is measured at `qd` [rad/s]: a stop may be over."""
        stop = self.stop
        if stop is not None and stop.over(qd, steps) and stop.then is not None:
            self.stop = None
            self.enter(stop.then)

    def _make(self, transition: Transition, to: State) -> None:
        match transition:
            case Transition.SHUTDOWN:
                self._axis.rescale()
                self.enter(to)
            case Transition.ENABLE_OPERATION:
                self._axis.stay()
                self._begin(to)
            case Transition.ENABLE_FROM_QUICK_STOP:
                self._begin(to)
            case Transition.DISABLE_OPERATION:
                self._leave(keys.DISABLE_OPTION, to)
            case Transition.SHUTDOWN_FROM_ENABLED:
                self._leave(keys.SHUTDOWN_OPTION, to)
            case Transition.QUICK_STOP:
                self._quick_stop(to)
            case Transition.DISABLE_FROM_ENABLED | Transition.QUICK_STOP_ENDED:
                self._lose(to)
            case Transition.FAULT_RESET:
                if self._fault_reset():
                    self.enter(to)
            case _:
                self.enter(to)

    def _begin(self, to: State) -> None:
        self.stop, self.halt, self.coasting = None, None, 0
        self.enter(to)
        self._begun()
        if self._word & HALT_BIT:
            self._turn_halt()

    def _leave(self, option_key: int, to: State) -> None:
        """By its option code: along a ramp and then, or at once without current."""
        option = option_of(self._axis.registers, option_key)
        if option:
            self._begin_stop(option, to)
        else:
            self._lose(to)

    def _quick_stop(self, to: State) -> None:
        option = option_of(self._axis.registers, keys.QUICK_STOP_OPTION)
        if not option:
            self._lose(State.SWITCH_ON_DISABLED)
            return
        self.enter(to)
        self._begin_stop(option, None if option >= STAYS else State.SWITCH_ON_DISABLED)

    def _ramp(self, option: int) -> Ramp:
        axis = self._axis
        return Ramp(axis.demand_q, axis.demand_qd, axis.deceleration(option))

    def _begin_stop(self, option: int, then: State | None) -> None:
        self.halt = None
        self.stop = Stop(self._ramp(option), then)

    def _lose(self, to: State) -> None:
        """Without current from now on."""
        self.stop = self.halt = None
        self.coasting = COASTING_STEPS
        self.enter(to)

    def _turn_halt(self) -> bool:
        """Begin or end a halt as bit 8 says; whether one has ended."""
        if self._word & HALT_BIT:
            self.halt = self._ramp(option_of(self._axis.registers, keys.HALT_OPTION))
            return False
        ended, self.halt = self.halt is not None, None
        return ended
