"""Brings all axes through the states of CiA 402 at once, and stops all when one falters.

Pure: what it knows is what the drives answered, what it says goes to `Outputs`. Times are counted
in cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hil_drivers.cia402 import objects as od
from hil_drivers.cia402 import states
from hil_drivers.cia402.complaints import Complaints
from hil_drivers.cia402.contracts import Emergency, Inputs, News, Outputs
from hil_drivers.cia402.judging import FAULTY, Judge, mode_text
from hil_drivers.cia402.phases import RUNNING, WATCHED, WITHIN_S, Phase
from hil_drivers.cia402.rest_watch import LONGEST_RAMP_S, BrakeWatch
from hil_drivers.cia402.states import (
    Goal,
    State,
    controlword_resetting,
    controlword_towards,
    state_of,
    told_by,
)
from hil_drivers.cia402.tracking import Tracking

__all__ = ["Phase", "Supervisor"]

SILENT_S = 1.0
"""How long quick stop is sent to axes that do not answer [s]."""

QUIET = 2
"""Answers in a row that are missing where the last known state is no news any more."""

TOLD_AFTER_S = 0.05
"""How long other news of the same mishap are waited for before it is told [s]."""


class Supervisor:
    """What the drives are told beside set-points: one `step` a cycle, by the cyclic thread.

    Args:
        nodes: Node ids, for messages; their number is that of the axes.
        period_s: Device time of a cycle [s].
        outputs: What it writes to: controlwords, modes, and preloaded targets.
        mode_mapped: Whether the process data hold 6060h and 6061h.
        late_cycles: Cycles in a row that an axis may not answer.
        braking: Watches quick stops.
        tracking: Watches whether enabled axes go where they are told.
        names: Of the axes, for messages.
        said: An emergency in words.

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
        said: Callable[[Emergency], str] = lambda emergency: f"EMCY {emergency.code:04X}h",
    ) -> None:
        self._n, self._period_s, self._outputs = len(nodes), period_s, outputs
        self._said, self._judge = said, Judge(len(nodes), mode_mapped, late_cycles)
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
        """Whether there is a problem that is not told yet."""
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
        """Begin to switch the mode of enabled axes at rest; what they measure is preloaded."""
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
        self._outputs.controlword[:] = [states.DISABLE_VOLTAGE] * self._n
        self._enter(Phase.RESETTING)

    def disable(self) -> None:
        """Begin to switch off axes at rest, one state at a time."""
        if self.phase not in (Phase.OFF, Phase.BRAKING):
            self._enter(Phase.DISABLING)

    def quick_stop(self, why: str = "") -> None:
        """Brake all axes now, by the drives' own ramps, and switch them off.

        Args:
            why: Told as the problem; none when empty.
        """
        if why:
            self._complaints.add(None, why, self._cycle)
        if self.phase is not Phase.BRAKING:
            self._enter(Phase.BRAKING)
            self._braking.begin()
        self._outputs.controlword[:] = [states.QUICK_STOP] * self._n

    def hear(self, news: News) -> None:
        """What came beside process data; before the `step` of the same cycle."""
        for emergency in news.emergencies:
            self._codes[emergency.axis] = emergency.code
            if emergency.code:
                self._complain(emergency.axis, self._said(emergency))
            else:
                self._complaints.forget(emergency.axis)
        for axis in news.booted:
            self._complain(axis, "has started anew and lost its configuration")
        for axis in news.silent:
            self._complain(axis, "its heartbeat is overdue")
        if news.bus_error:
            self._complain(None, news.bus_error)

    def step(self, inputs: Inputs, cycle: int) -> None:
        """Judge what the drives answered, and write what they are told next."""
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
        """What made it stop all axes, with all axes' states; told once, empty else."""
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
        """All axes wait for the last one at `SWITCHED_ON`: none is let go alone."""
        on = (State.SWITCHED_ON, State.ENABLED)
        together = all(state in on for state in self._states)
        words = self._outputs.controlword
        for axis, state in enumerate(self._states):
            word = controlword_towards(state, Goal.ENABLED)
            if word == states.ENABLE and not together:
                word = states.SWITCH_ON
            if words[axis] != states.ENABLE:
                self._preload((axis,))  # not any more once it has been let go
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
        """Quick stop until no axis carries current; silent ones may hear it all the same."""
        carrying = [axis for axis in range(self._n) if self._states[axis] in states.POWERED]
        self._let_go_what_does_not_brake(carrying, inputs)
        answering = any(self._judge.answers(axis) for axis in carrying)
        given_s = WITHIN_S[Phase.BRAKING] if answering else SILENT_S
        if not carrying or self._for_s() > given_s:
            self._enter(Phase.OFF)
            self._steer(Goal.OFF)
        else:
            self._steer(Goal.QUICK_STOP)

    def _let_go_what_does_not_brake(self, carrying: list[int], inputs: Inputs) -> None:
        """Better a brake that closes on a moving joint than one that goes on moving."""
        self._braking.look(inputs)
        for axis in set(carrying) - self._let_go:
            answers = self._judge.answers(axis)
            if answers and (said := self._braking.complaint(axis, self._for_s())):
                self._let_go.add(axis)
                self._complaints.add(axis, said, self._cycle)

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
            what = told_by(inputs.statusword[axis])
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
            words[axis] = states.DISABLE_VOLTAGE

    def _preload(self, axes: tuple[int, ...] | range) -> None:
        """Targets are where the axes are: nothing jumps when they are enabled."""
        outputs, inputs = self._outputs, self._inputs
        for axis in axes:
            outputs.target_position[axis] = inputs.position[axis]
            outputs.target_velocity[axis] = outputs.torque_offset[axis] = 0
            outputs.target_torque[axis] = 0
