"""All axes together: brought through the states of CiA 402 at once, all stopped when one falters.

`Supervisor.step` runs once a cycle, in the thread that owns the bus. It is pure: what it knows is
what the drives have answered (`Inputs`, `News`), what it decides goes to `Outputs`; it has no clock
but the number of cycles. It is in one `Phase` at a time, and `_go_on` says what each phase does
with the answers. Two helpers have the details: `Judge` finds what is wrong with which axis in one
cycle's answers, `Complaints` gathers that until it is worth one message.

Whatever goes wrong in a phase of `WATCHED` stops all axes by their own quick stop (`BRAKING`): an
arm of which one joint has failed must not go on with the others.

| phase                           | event                                             | next phase |
|---------------------------------|---------------------------------------------------|------------|
| OFF                             | `enable`                                          | MODE       |
| OFF                             | `reset`                                           | RESETTING  |
| RESETTING                       | no axis is in fault                               | OFF        |
| MODE                            | all show the mode and are switch on disabled      | ENABLING   |
| ENABLING                        | all axes are operation enabled                    | ENABLED    |
| ENABLED                         | `switch`                                          | SWITCHING  |
| SWITCHING                       | all axes show the mode                            | ENABLED    |
| any but OFF, BRAKING            | `disable`                                         | DISABLING  |
| DISABLING                       | all are switch on disabled or not ready           | OFF        |
| any                             | `quick_stop`                                      | BRAKING    |
| any but OFF, RESETTING, BRAKING | something is wrong with an axis or the bus        | BRAKING    |
| any but OFF, ENABLED, BRAKING   | it lasts longer than `WITHIN_S`                   | BRAKING    |
| BRAKING                         | no axis has current, or none answers (`SILENT_S`) | OFF        |
| BRAKING                         | it lasts longer than `WITHIN_S`                   | OFF        |
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from enum import Enum

from hil_drivers.cia402 import objects as od
from hil_drivers.cia402.axis import (
    DISABLE_VOLTAGE,
    ENABLE,
    FAULTY,
    FOLLOWS_COMMAND,
    LONGEST_RAMP_S,
    POWERED,
    QUICK_STOP,
    SWITCH_ON,
    BrakeWatch,
    Goal,
    State,
    Tracking,
    controlword_resetting,
    controlword_towards,
    mode_text,
    state_of,
    statusword_text,
)
from hil_drivers.cia402.bus import Inputs, News, Outputs


class Phase(Enum):
    """Where all axes together are."""

    OFF = "off"
    RESETTING = "resetting faults"
    MODE = "setting the mode"
    ENABLING = "enabling"
    ENABLED = "enabled"
    SWITCHING = "switching the mode"
    BRAKING = "quick stop"
    DISABLING = "switching off"


WITHIN_S = {
    Phase.RESETTING: 2.0,
    Phase.MODE: 2.0,
    Phase.ENABLING: 5.0,
    Phase.SWITCHING: 1.0,
    Phase.BRAKING: 10.0,
    Phase.DISABLING: 5.0,
}
"""How long a phase may take, by device time [s]; releasing brakes takes some of `ENABLING`."""

RUNNING = (Phase.ENABLED, Phase.SWITCHING)
"""The drives follow set-points."""

WATCHED = (Phase.MODE, Phase.ENABLING, Phase.ENABLED, Phase.SWITCHING, Phase.DISABLING)
"""Something is on, or about to be: whatever goes wrong stops all axes."""

SILENT_S = 1.0
"""How long quick stop is sent to axes that do not answer [s]."""

QUIET = 2
"""Answers in a row that are missing where the last known state is no news any more."""

TOLD_AFTER_S = 0.05
"""Time in which further news of the same mishap is gathered into one message [s]."""


class Supervisor:
    """Brings all axes through their states: one `step` a cycle, by the cyclic thread.

    Args:
        nodes: Node ids, for messages; their number is that of the axes.
        period_s: Device time of a cycle [s].
        outputs: Where it writes controlwords, modes, and preloaded targets.
        mode_mapped: Whether the process data hold 6060h and 6061h.
        late_cycles: Cycles in a row that an axis may not answer.
        braking: Watches quick stops.
        tracking: Watches whether enabled axes follow their set-points.
        names: Of the axes, for messages.

    Attributes:
        phase: Where the axes are.
        mode: The mode asked for last.
        fault_code: EMCY code that the first axis in fault has sent; 0 without a fault.
        overdue: Whether what stopped the axes last is that a phase took too long.
    """

    def __init__(
        self,
        nodes: tuple[int, ...],
        period_s: float,
        outputs: Outputs,
        *,
        mode_mapped: bool = True,
        late_cycles: int = 3,
        braking: BrakeWatch | None = None,
        tracking: Tracking | None = None,
        names: Sequence[str] = (),
    ) -> None:
        self._n, self._period_s, self._outputs = len(nodes), period_s, outputs
        self._judge = Judge(len(nodes), mode_mapped, late_cycles)
        names = names or [f"axis {axis + 1}" for axis in range(len(nodes))]
        self._complaints = Complaints(names, nodes)
        n = self._n
        self._braking = braking or BrakeWatch(period_s, [0.0] * n, [LONGEST_RAMP_S] * n)
        self._let_go: set[int] = set()
        self._tracking = tracking
        self._codes = [0] * self._n
        self._states = [State.UNKNOWN] * self._n
        self._inputs = Inputs.none_yet(self._n)
        self._cycle = self._since = 0
        self.phase, self.mode = Phase.OFF, 0
        self.overdue, self.fault_code = False, 0
        self._go_on: dict[Phase, Callable[[Inputs], None]] = {
            Phase.OFF: self._stay_off,
            Phase.RESETTING: self._reset,
            Phase.MODE: self._set_mode,
            Phase.ENABLING: self._go_on_enabling,
            Phase.ENABLED: self._stay_enabled,
            Phase.SWITCHING: self._go_on_switching,
            Phase.BRAKING: self._brake,
            Phase.DISABLING: self._go_on_disabling,
        }

    @property
    def running(self) -> bool:
        """Whether the drives follow set-points."""
        return self.phase in RUNNING

    @property
    def complains(self) -> bool:
        """Whether there is a problem that `take_problem` has not returned yet."""
        return bool(self._complaints)

    def enable(self, mode: int) -> None:
        """Begin to enable all axes in a mode; not while any is enabled."""
        self._complaints.clear()
        self._let_go.clear()
        self.overdue = False
        self.mode = mode
        self._outputs.mode[:] = [mode] * self._n
        self._enter(Phase.MODE)

    def switch(self, mode: int) -> None:
        """Begin to switch the mode of enabled axes at rest, with measured values preloaded."""
        before, self.mode = self.mode, mode
        outputs, inputs = self._outputs, self._inputs
        if before != od.CSP:
            outputs.target_position[:] = inputs.position
        outputs.target_velocity[:] = [0] * self._n
        if before != od.CST:
            outputs.target_torque[:] = inputs.torque
        outputs.mode[:] = [mode] * self._n
        self._enter(Phase.SWITCHING)

    def reset(self) -> None:
        """Begin to reset the faults of all axes."""
        self._complaints.clear()
        self._outputs.controlword[:] = [DISABLE_VOLTAGE] * self._n
        self._enter(Phase.RESETTING)

    def disable(self) -> None:
        """Begin to switch off axes at rest, one state at a time."""
        if self.phase not in (Phase.OFF, Phase.BRAKING):
            self._enter(Phase.DISABLING)

    def quick_stop(self, why: str = "") -> None:
        """Brake all axes now, by the drives' own ramps, and switch them off.

        Args:
            why: The problem, for the message; none when empty.
        """
        if why:
            self._complaints.add(None, why, self._cycle)
        if self.phase is not Phase.BRAKING:
            self._enter(Phase.BRAKING)
            self._braking.begin()
        self._outputs.controlword[:] = [QUICK_STOP] * self._n

    def hear(self, news: News) -> None:
        """Take messages beside process data; to be called before the `step` of the same cycle."""
        for emergency in news.emergencies:
            self._codes[emergency.axis] = emergency.code
            if emergency.code:
                self._complain(emergency.axis, str(emergency))
            else:
                self._complaints.forget(emergency.axis)
        for axis in news.booted:
            self._complain(axis, "has started anew and lost its configuration")
        for axis in news.silent:
            self._complain(axis, "its heartbeat is overdue")
        if news.bus_error:
            self._complain(None, news.bus_error)

    def step(self, inputs: Inputs, cycle: int) -> None:
        """Judge the answers of the drives, and write the next controlwords and modes."""
        self._cycle, self._inputs = cycle, inputs
        judge = self._judge
        if self._tracking and self.phase is Phase.ENABLED:
            targets = self._outputs.target_position
            for axis, what in list(self._tracking.judge(inputs, targets, self.mode)):
                self._complain(axis, what)
        if self.phase is Phase.ENABLED and judge.is_calm(inputs, self._outputs.mode):
            return
        self._states = [state_of(word) for word in inputs.statusword]
        faulty = [code for code, s in zip(self._codes, self._states, strict=True) if s in FAULTY]
        self.fault_code = faulty[0] if faulty else 0
        judge.count(inputs)
        if self.phase in WATCHED:
            wrong = judge.judge(inputs, self._states, self.phase, self.mode, self._for_s())
            for axis, what in list(wrong):
                self._complain(axis, what)
        self._go_on[self.phase](inputs)
        judge.settle(inputs, self.phase)

    def take_problem(self) -> str:
        """Return and clear the problem that stopped all axes, with their states; empty if none."""
        waited = self._cycle - self._complaints.since >= TOLD_AFTER_S / self._period_s
        if not self._complaints or not waited:
            return ""
        missed = self._judge.missed
        now = [None if missed[a] > QUIET else state for a, state in enumerate(self._states)]
        return self._complaints.take(now)

    def _complain(self, axis: int | None, what: str) -> None:
        """Note it; stop all when anything is on."""
        if self.phase in WATCHED:
            self._complaints.add(axis, what, self._cycle)
            self.quick_stop()
        elif self._complaints:
            self._complaints.add(axis, what, self._cycle)
        elif axis is not None:
            self._complaints.keep(axis, what)

    # -- what comes next, by phase

    def _stay_off(self, inputs: Inputs) -> None:
        self._preload(range(self._n))
        self._steer(Goal.OFF)

    def _reset(self, inputs: Inputs) -> None:
        self._preload(range(self._n))
        words = self._outputs.controlword
        for axis, state in enumerate(self._states):
            words[axis] = controlword_resetting(state, words[axis])
        if not any(state in FAULTY for state in self._states):
            self._enter(Phase.OFF)
        elif self._is_overdue():
            self._give_up([axis for axis in range(self._n) if self._states[axis] in FAULTY])

    def _set_mode(self, inputs: Inputs) -> None:
        self._preload(range(self._n))
        self._steer(Goal.OFF)
        wrong = self._judge.in_wrong_mode(inputs, self.mode)
        ready = [state is State.DISABLED for state in self._states]
        if not wrong and all(ready):
            self._enter(Phase.ENABLING)
        elif self._is_overdue():
            self._give_up(wrong or [axis for axis, is_so in enumerate(ready) if not is_so])

    def _go_on_enabling(self, inputs: Inputs) -> None:
        """Enable the axes together: all wait for the last one at `SWITCHED_ON`."""
        on = (State.SWITCHED_ON, State.ENABLED)
        together = all(state in on for state in self._states)
        words = self._outputs.controlword
        for axis, state in enumerate(self._states):
            word = controlword_towards(state, Goal.ENABLED)
            if word == ENABLE and not together:
                word = SWITCH_ON
            if words[axis] != ENABLE:
                self._preload((axis,))  # no longer once it may be enabled
            words[axis] = word
        if all(state is State.ENABLED for state in self._states):
            self._enter(Phase.ENABLED)
        elif self._is_overdue():
            self._give_up([a for a in range(self._n) if self._states[a] is not State.ENABLED])

    def _stay_enabled(self, inputs: Inputs) -> None:
        self._steer(Goal.ENABLED)

    def _go_on_switching(self, inputs: Inputs) -> None:
        wrong = self._judge.in_wrong_mode(inputs, self.mode)
        if not wrong:
            self._enter(Phase.ENABLED)
        elif self._is_overdue():
            self._give_up(wrong)

    def _brake(self, inputs: Inputs) -> None:
        """Send quick stop until no axis has current; silent axes may still receive it."""
        carrying = [axis for axis in range(self._n) if self._states[axis] in POWERED]
        self._switch_off_what_does_not_brake(carrying, inputs)
        answering = any(self._judge.answers(axis) for axis in carrying)
        given_s = WITHIN_S[Phase.BRAKING] if answering else SILENT_S
        if not carrying or self._for_s() > given_s:
            self._enter(Phase.OFF)
            self._steer(Goal.OFF)
        else:
            self._steer(Goal.QUICK_STOP)

    def _switch_off_what_does_not_brake(self, carrying: list[int], inputs: Inputs) -> None:
        """Switch off axes that do not brake: better a closing brake than a joint that moves on."""
        self._braking.look(inputs)
        for axis in set(carrying) - self._let_go:
            answers = self._judge.answers(axis)
            if answers and (complaint := self._braking.complaint(axis, self._for_s())):
                self._let_go.add(axis)
                self._complaints.add(axis, complaint, self._cycle)

    def _go_on_disabling(self, inputs: Inputs) -> None:
        self._steer(Goal.OFF)
        off = (State.DISABLED, State.NOT_READY)
        left = [axis for axis, state in enumerate(self._states) if state not in off]
        if not left:
            self._enter(Phase.OFF)
        elif self._is_overdue():
            self._give_up(left)

    # -- parts of these

    def _enter(self, phase: Phase) -> None:
        self.phase, self._since = phase, self._cycle
        self._judge.enter(phase)
        if self._tracking:
            self._tracking.restart()

    def _for_s(self) -> float:
        return (self._cycle - self._since) * self._period_s

    def _is_overdue(self) -> bool:
        return self._for_s() > WITHIN_S[self.phase]

    def _give_up(self, axes: list[int]) -> None:
        """A phase has taken too long because of these axes."""
        inputs, within_s = self._inputs, WITHIN_S[self.phase]
        asks_mode = self.phase in (Phase.MODE, Phase.SWITCHING)
        wrong = self._judge.in_wrong_mode(inputs, self.mode) if asks_mode else []
        for axis in axes:
            what = statusword_text(inputs.statusword[axis])
            if axis in wrong:
                shown = mode_text(inputs.mode_display[axis])
                what = f"mode {mode_text(self.mode)} was asked for, it shows {shown}; {what}"
            text = f"{self.phase.value} took longer than {within_s:g} s: {what}"
            self._complaints.add(axis, text, self._cycle)
        self.overdue = True
        self.quick_stop()

    def _steer(self, goal: Goal) -> None:
        words = self._outputs.controlword
        words[:] = [controlword_towards(s, goal) for s in self._states]
        for axis in self._let_go:
            words[axis] = DISABLE_VOLTAGE

    def _preload(self, axes: tuple[int, ...] | range) -> None:
        """Targets are where the axes are: nothing jumps when they are enabled."""
        outputs, inputs = self._outputs, self._inputs
        for axis in axes:
            outputs.target_position[axis] = inputs.position[axis]
            outputs.target_velocity[axis] = outputs.torque_offset[axis] = 0
            outputs.target_torque[axis] = 0


FOLLOWS_WITHIN_S = 0.1
"""How long after enabling or switching bit 12 may stay low [s]."""

BEHIND_TIMES = 3
"""Times `late_cycles` for which an axis may be behind: its answers come, but to older SYNCs."""


class Judge:
    """Finds problems of the axes in the answers of one cycle.

    Args:
        n: Axes.
        mode_mapped: Whether the process data hold 6060h and 6061h.
        late_cycles: Cycles in a row that an axis may not answer.

    Attributes:
        missed: Per axis, cycles in a row that it has not answered.
    """

    def __init__(self, n: int, mode_mapped: bool, late_cycles: int) -> None:
        self._n, self._mode_mapped, self._late_cycles = n, mode_mapped, late_cycles
        self._all_fresh = [True] * n
        self.missed, self._behind = [0] * n, [0] * n
        self._follows = [False] * n
        self._calm: list[int] = []

    def enter(self, phase: Phase) -> None:
        """A phase begins: bit 12 has time again."""
        self._follows, self._calm = [False] * self._n, []
        if phase is Phase.MODE:
            self.missed, self._behind = [0] * self._n, [0] * self._n

    def answers(self, axis: int) -> bool:
        """Whether an axis has answered lately."""
        most = self._late_cycles
        return self.missed[axis] <= most and self._behind[axis] <= BEHIND_TIMES * most

    def is_calm(self, inputs: Inputs, mode: Sequence[int]) -> bool:
        """Nothing is other than when all was well; saves looking at every axis."""
        return (
            inputs.statusword == self._calm
            and inputs.fresh == self._all_fresh
            and (not self._mode_mapped or inputs.mode_display == mode)
        )

    def count(self, inputs: Inputs) -> None:
        """Who has answered; once a cycle."""
        self.missed = [
            0 if came or late else missed + 1
            for came, late, missed in zip(inputs.fresh, inputs.late, self.missed, strict=True)
        ]
        self._behind = [
            0 if came else behind + 1
            for came, behind in zip(inputs.fresh, self._behind, strict=True)
        ]

    def settle(self, inputs: Inputs, phase: Phase) -> None:
        """Note, once all has followed from these answers, whether nothing is left to change."""
        well = phase is Phase.ENABLED and all(self._follows) and not any(self._behind)
        self._calm = inputs.statusword.copy() if well else []

    def judge(
        self, inputs: Inputs, found: Sequence[State], phase: Phase, mode: int, for_s: float
    ) -> Iterator[tuple[int, str]]:
        """Yield the axes that are not as expected, each with the problem.

        Args:
            inputs: Of this cycle.
            found: Per axis, what its statusword says.
            phase: Of all axes, since `for_s` [s].
            mode: That they are to be in.
            for_s: See `phase`.
        """
        for axis, state in enumerate(found):
            word = inputs.statusword[axis]
            if not self.answers(axis):
                yield axis, self._silence(axis)
            elif state in FAULTY:
                yield axis, statusword_text(word)
            elif phase in RUNNING and state is not State.ENABLED:
                yield axis, f"has left operation enabled: {statusword_text(word)}"
            elif phase is Phase.ENABLED and self._is_in_wrong_mode(axis, inputs, mode):
                yield axis, f"has left mode {mode_text(mode)} on its own"
            elif phase is Phase.ENABLED and not self._follows_now(axis, word, for_s):
                yield axis, f"ignores set-points (bit 12 low): {statusword_text(word)}"

    def _silence(self, axis: int) -> str:
        if self.missed[axis] > self._late_cycles:
            return f"has not answered {self.missed[axis]} SYNCs in a row"
        return f"has answered none of {self._behind[axis]} SYNCs in time"

    def in_wrong_mode(self, inputs: Inputs, mode: int) -> list[int]:
        """Axes that show another mode."""
        return [a for a in range(self._n) if self._is_in_wrong_mode(a, inputs, mode)]

    def _is_in_wrong_mode(self, axis: int, inputs: Inputs, mode: int) -> bool:
        return self._mode_mapped and inputs.mode_display[axis] != mode

    def _follows_now(self, axis: int, word: int, for_s: float) -> bool:
        """Once bit 12 has been high it has to stay so."""
        if word & FOLLOWS_COMMAND:
            self._follows[axis] = True
            return True
        return not self._follows[axis] and for_s <= FOLLOWS_WITHIN_S


STOPPED = "All axes were stopped"
TOLD = "All axes were told to stop"
UNKNOWN = "not known to have stopped"
NONE_ANSWERS = (
    "No axis answers: quick stop may not arrive, but without a master drives stop by themselves"
)

_MOVING = (None, State.ENABLED, State.UNKNOWN)
"""States in which nothing says that an axis brakes or is off; None: it does not answer."""


class Complaints:
    """Collects the problems that made all axes stop, until they are worth one message.

    Args:
        names, nodes: Of the axes.

    Attributes:
        since: Cycle of the first one.
    """

    def __init__(self, names: Sequence[str], nodes: Sequence[int]) -> None:
        self._names = names
        self._axes = [f"{name} (node {node})" for name, node in zip(names, nodes, strict=True)]
        self._of_bus: list[str] = []
        self._of_axes: dict[int, list[str]] = {}
        self._before: dict[int, str] = {}
        self.since = 0

    def __bool__(self) -> bool:
        return bool(self._of_bus or self._of_axes)

    def clear(self) -> None:
        """Forget the problems; explanations that were kept stay."""
        self._of_bus, self._of_axes = [], {}

    def add(self, axis: int | None, what: str, cycle: int) -> None:
        """Note it, once; no axis when it is the bus or all of them."""
        if not self:
            self.since = cycle
        known = self._of_bus if axis is None else self._of_axes.setdefault(axis, [])
        if axis in self._before:
            known.append(self._before.pop(axis))
        if what not in known:
            known.append(what)

    def keep(self, axis: int, what: str) -> None:
        """Keep something that stops nothing now but may explain a later problem."""
        self._before[axis] = what

    def forget(self, axis: int) -> None:
        """Forget what was kept of an axis whose errors are gone."""
        self._before.pop(axis, None)

    def take(self, states: Sequence[State | None]) -> str:
        """All in one message, the state of the other axes with it; nothing is left then.

        Args:
            states: Per axis, None where it does not answer.
        """
        parts = list(self._of_bus)
        parts += [
            f"{self._axes[axis]}: {'; '.join(whats)}" for axis, whats in self._of_axes.items()
        ]
        told, fate = "; ".join(parts), self._fate(states)
        self.clear()
        return f"{told}. {fate}" if fate else told

    def _fate(self, states: Sequence[State | None]) -> str:
        """Return the state of the other axes; only a statusword counts as a stop."""
        if not any(states):
            return NONE_ANSWERS
        moving = [axis for axis, state in enumerate(states) if state in _MOVING]
        others: dict[str, list[str]] = {}
        for axis, state in enumerate(states):
            if state is not None and axis not in moving and axis not in self._of_axes:
                others.setdefault(state.value, []).append(self._names[axis])
        if moving:
            others[UNKNOWN] = [self._names[axis] for axis in moving]
        by_state = [f"{', '.join(names)}: {state}" for state, names in others.items()]
        return "; ".join([TOLD if moving else STOPPED, *by_state]) if by_state else ""
