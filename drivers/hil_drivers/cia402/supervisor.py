"""Supervisor that leads all axes through the CiA 402 states, and stops all if one fails.

`Supervisor.step` runs once a cycle, in the thread that owns the bus. The inputs of `step` are the
answers of the drives (`Inputs`, `News`), and its outputs are the commands to the drives
(`Outputs`). Time is measured only by counting cycles. All axes are in one `Phase` at a time, and
`_go_on` maps each phase to the method that handles the answers. Two helper classes are used:
`Judge` checks the answers of one cycle for problems, `Complaints` collects the problems for one
message.

Any problem in a phase of `WATCHED` stops all axes with the quick stop of the drives (`BRAKING`),
because an arm with one failed joint must not move with the others.

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
    """Common phase of all axes, such as enabling or braking."""

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
"""Maximum duration of each phase in device time [s]; `ENABLING` includes brake release."""

RUNNING = (Phase.ENABLED, Phase.SWITCHING)
"""Phases in which the drives follow set-points."""

WATCHED = (Phase.MODE, Phase.ENABLING, Phase.ENABLED, Phase.SWITCHING, Phase.DISABLING)
"""Phases in which axes are on or about to be switched on; any problem stops all axes."""

SILENT_S = 1.0
"""Duration of sending quick stops to axes that do not answer [s]."""

QUIET = 2
"""Number of consecutive missing answers above which the last state of an axis is outdated."""

TOLD_AFTER_S = 0.05
"""Device time during which related problems are collected into one message [s]."""


class Supervisor:
    """State machine of all axes together; the cyclic thread calls `step` once per cycle.

    Args:
        nodes: Node ids of the axes, used in messages.
        period_s: Device time of a cycle [s].
        outputs: Object into which controlwords, modes and preloaded targets are written.
        mode_mapped: Whether the process data contain the mode objects 6060h and 6061h.
        late_cycles: Tolerated number of consecutive cycles without an answer of an axis.
        braking: Monitor of quick stops.
        tracking: Monitor of the deviation of enabled axes from their set-points.
        names: Names of the joints, in the order of the axes, for messages.

    Attributes:
        phase: Present phase of the axes.
        mode: Mode of operation that was requested last.
        fault_code: EMCY code of the first axis in fault; 0 without a fault.
        overdue: Whether the last stop was caused by a phase that took too long.
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
        """Whether a problem exists that `take_problem` has not yet returned."""
        return bool(self._complaints)

    def enable(self, mode: int) -> None:
        """Begin to enable all axes, which must be off, in a mode of operation."""
        self._complaints.clear()
        self._let_go.clear()
        self.overdue = False
        self.mode = mode
        self._outputs.mode[:] = [mode] * self._n
        self._enter(Phase.MODE)

    def switch(self, mode: int) -> None:
        """Begin to change the mode of enabled axes at rest, with measured values as targets."""
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
        """Start a quick stop of all axes with the ramps of the drives, then switch the axes off.

        Args:
            why: Problem that is reported in the message; empty for a stop without a problem.
        """
        if why:
            self._complaints.add(None, why, self._cycle)
        if self.phase is not Phase.BRAKING:
            self._enter(Phase.BRAKING)
            self._braking.begin()
        self._outputs.controlword[:] = [QUICK_STOP] * self._n

    def hear(self, news: News) -> None:
        """Process messages other than process data; call this before `step` of the same cycle."""
        for emergency in news.emergencies:
            self._codes[emergency.axis] = emergency.code
            if emergency.code:
                self._complain(emergency.axis, str(emergency))
            else:
                self._complaints.forget(emergency.axis)
        for axis in news.booted:
            self._complain(axis, "has restarted and lost its configuration")
        for axis in news.silent:
            self._complain(axis, "its heartbeat is overdue")
        if news.bus_error:
            self._complain(None, news.bus_error)

    def step(self, inputs: Inputs, cycle: int) -> None:
        """Check the answers of the drives and write the next controlwords and modes."""
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
        """Record a problem of an axis, or of the bus (None); stop all axes in a `WATCHED` phase."""
        if self.phase in WATCHED:
            self._complaints.add(axis, what, self._cycle)
            self.quick_stop()
        elif self._complaints:
            self._complaints.add(axis, what, self._cycle)
        elif axis is not None:
            self._complaints.keep(axis, what)

    # -- handlers of the phases

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
        """Enable the axes together: all axes wait in `SWITCHED_ON` for the last axis."""
        on = (State.SWITCHED_ON, State.ENABLED)
        together = all(state in on for state in self._states)
        words = self._outputs.controlword
        for axis, state in enumerate(self._states):
            word = controlword_towards(state, Goal.ENABLED)
            if word == ENABLE and not together:
                word = SWITCH_ON
            if words[axis] != ENABLE:
                self._preload((axis,))  # only until enabling is commanded
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
        """Send quick stops until no axis carries current, also to axes that do not answer."""
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
        """Disable the voltage of axes that do not brake, so that their mechanical brakes close."""
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

    # -- helpers of the phases

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
        """Report the axes that made a phase take too long, and stop all axes."""
        inputs, within_s = self._inputs, WITHIN_S[self.phase]
        asks_mode = self.phase in (Phase.MODE, Phase.SWITCHING)
        wrong = self._judge.in_wrong_mode(inputs, self.mode) if asks_mode else []
        for axis in axes:
            what = statusword_text(inputs.statusword[axis])
            if axis in wrong:
                shown = mode_text(inputs.mode_display[axis])
                what = f"mode {mode_text(self.mode)} was requested, 6061h shows {shown}; {what}"
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
        """Set the targets to the measured positions, so that no axis jumps when it is enabled."""
        outputs, inputs = self._outputs, self._inputs
        for axis in axes:
            outputs.target_position[axis] = inputs.position[axis]
            outputs.target_velocity[axis] = outputs.torque_offset[axis] = 0
            outputs.target_torque[axis] = 0


FOLLOWS_WITHIN_S = 0.1
"""Time after enabling or a mode change in which bit 12 of the statusword can be low [s]."""

BEHIND_TIMES = 3
"""Tolerated number of cycles, in `late_cycles`, in which answers belong to older SYNCs."""


class Judge:
    """Detector of problems of the axes in the answers of one cycle.

    Args:
        n: Number of axes.
        mode_mapped: Whether the process data contain the mode objects 6060h and 6061h.
        late_cycles: Tolerated number of consecutive cycles without an answer of an axis.

    Attributes:
        missed: Number of consecutive cycles without an answer, per axis.
    """

    def __init__(self, n: int, mode_mapped: bool, late_cycles: int) -> None:
        self._n, self._mode_mapped, self._late_cycles = n, mode_mapped, late_cycles
        self._all_fresh = [True] * n
        self.missed, self._behind = [0] * n, [0] * n
        self._follows = [False] * n
        self._calm: list[int] = []

    def enter(self, phase: Phase) -> None:
        """Start a phase, in which bit 12 of the statusword can be low for `FOLLOWS_WITHIN_S`."""
        self._follows, self._calm = [False] * self._n, []
        if phase is Phase.MODE:
            self.missed, self._behind = [0] * self._n, [0] * self._n

    def answers(self, axis: int) -> bool:
        """Return whether an axis has answered recently."""
        most = self._late_cycles
        return self.missed[axis] <= most and self._behind[axis] <= BEHIND_TIMES * most

    def is_calm(self, inputs: Inputs, mode: Sequence[int]) -> bool:
        """Return whether statuswords and modes equal those of the last fault-free cycle.

        Because of the comparison with the last fault-free cycle, most cycles need no check of every
        single axis.
        """
        return (
            inputs.statusword == self._calm
            and inputs.fresh == self._all_fresh
            and (not self._mode_mapped or inputs.mode_display == mode)
        )

    def count(self, inputs: Inputs) -> None:
        """Count missing and late answers per axis; call once a cycle."""
        self.missed = [
            0 if came or late else missed + 1
            for came, late, missed in zip(inputs.fresh, inputs.late, self.missed, strict=True)
        ]
        self._behind = [
            0 if came else behind + 1
            for came, behind in zip(inputs.fresh, self._behind, strict=True)
        ]

    def settle(self, inputs: Inputs, phase: Phase) -> None:
        """Store the statuswords for `is_calm` if all axes follow their set-points on time."""
        well = phase is Phase.ENABLED and all(self._follows) and not any(self._behind)
        self._calm = inputs.statusword.copy() if well else []

    def judge(
        self, inputs: Inputs, states: Sequence[State], phase: Phase, mode: int, for_s: float
    ) -> Iterator[tuple[int, str]]:
        """Yield the number of each axis with a problem, and the problem as text.

        Args:
            inputs: Answers of the drives in this cycle.
            states: State of each axis according to its statusword.
            phase: Phase of all axes.
            mode: Required mode of operation.
            for_s: Device time since the phase began [s].
        """
        for axis, state in enumerate(states):
            word = inputs.statusword[axis]
            if not self.answers(axis):
                yield axis, self._silence(axis)
            elif state in FAULTY:
                yield axis, statusword_text(word)
            elif phase in RUNNING and state is not State.ENABLED:
                yield axis, f"has left operation enabled: {statusword_text(word)}"
            elif phase is Phase.ENABLED and self._is_in_wrong_mode(axis, inputs, mode):
                yield axis, f"has left mode {mode_text(mode)} without a command"
            elif phase is Phase.ENABLED and not self._follows_now(axis, word, for_s):
                yield axis, f"ignores set-points (bit 12 low): {statusword_text(word)}"

    def _silence(self, axis: int) -> str:
        if self.missed[axis] > self._late_cycles:
            return f"has not answered {self.missed[axis]} SYNCs in a row"
        return f"has answered none of {self._behind[axis]} SYNCs in time"

    def in_wrong_mode(self, inputs: Inputs, mode: int) -> list[int]:
        """Return the axes whose drives show a mode other than the requested mode."""
        return [a for a in range(self._n) if self._is_in_wrong_mode(a, inputs, mode)]

    def _is_in_wrong_mode(self, axis: int, inputs: Inputs, mode: int) -> bool:
        return self._mode_mapped and inputs.mode_display[axis] != mode

    def _follows_now(self, axis: int, word: int, for_s: float) -> bool:
        """Return whether an axis follows set-points: bit 12 must remain high after it was high."""
        if word & FOLLOWS_COMMAND:
            self._follows[axis] = True
            return True
        return not self._follows[axis] and for_s <= FOLLOWS_WITHIN_S


STOPPED = "All axes were stopped"
STOP_SENT = "A stop was sent to all axes"
UNKNOWN = "stop not confirmed"
NONE_ANSWERS = (
    "No axis answers: the quick stop possibly does not arrive, but the drives stop by themselves "
    "without the heartbeat of the master"
)

_MOVING = (None, State.ENABLED, State.UNKNOWN)
"""States that do not prove that an axis brakes or is off; None for an axis without answer."""


class Complaints:
    """Collection of the problems that stopped all axes, which are returned in one message.

    Args:
        names: Names of the axes.
        nodes: Node ids of the axes.

    Attributes:
        since: Number of the cycle in which the first problem was added.
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
        """Clear all problems, but not the explanations stored by `keep`."""
        self._of_bus, self._of_axes = [], {}

    def add(self, axis: int | None, what: str, cycle: int) -> None:
        """Add a problem that is new; `axis` is None for a problem of the bus or of all axes."""
        if not self:
            self.since = cycle
        known = self._of_bus if axis is None else self._of_axes.setdefault(axis, [])
        if axis in self._before:
            known.append(self._before.pop(axis))
        if what not in known:
            known.append(what)

    def keep(self, axis: int, what: str) -> None:
        """Store an event that stops nothing now but possibly explains a later problem."""
        self._before[axis] = what

    def forget(self, axis: int) -> None:
        """Drop the stored event of an axis whose errors are gone."""
        self._before.pop(axis, None)

    def take(self, states: Sequence[State | None]) -> str:
        """Return a message with all problems and the states of the other axes; clear the problems.

        Args:
            states: State of each axis; None for an axis that does not answer.
        """
        parts = list(self._of_bus)
        parts += [
            f"{self._axes[axis]}: {'; '.join(whats)}" for axis, whats in self._of_axes.items()
        ]
        problems, fate = "; ".join(parts), self._fate(states)
        self.clear()
        return f"{problems}. {fate}" if fate else problems

    def _fate(self, states: Sequence[State | None]) -> str:
        """Return the states of all axes without a problem as text."""
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
        return "; ".join([STOP_SENT if moving else STOPPED, *by_state]) if by_state else ""
