"""Brings all axes through the states of CiA 402 at once, and stops all when one falters.

Pure: what it knows is what the drives answered, what it says goes to `Outputs`. Times are counted
in cycles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum

from hil_drivers.cia402 import objects as od
from hil_drivers.cia402 import states
from hil_drivers.cia402.complaints import Complaints
from hil_drivers.cia402.contracts import Emergency, Inputs, News, Outputs
from hil_drivers.cia402.states import (
    Goal,
    State,
    controlword_resetting,
    controlword_towards,
    state_of,
    told_by,
)


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

FOLLOWS_WITHIN_S = 0.1
"""How long after enabling or switching bit 12 may stay low [s]."""

SILENT_S = 1.0
"""How long quick stop is sent to axes that do not answer [s]."""

TOLD_AFTER_S = 0.05
"""How long other news of the same mishap are waited for before it is told [s]."""

_FAULTY = (State.FAULT, State.FAULT_REACTION)
_RUNNING = (Phase.ENABLED, Phase.SWITCHING)
_WATCHED = (Phase.MODE, Phase.ENABLING, Phase.ENABLED, Phase.SWITCHING, Phase.DISABLING)


class Supervisor:
    """What the drives are told beside set-points: one `step` a cycle, by the cyclic thread.

    Args:
        nodes: Node ids, for messages; their number is that of the axes.
        period_s: Device time of a cycle [s].
        outputs: What it writes to: controlwords, modes, and preloaded targets.
        mode_mapped: Whether the process data hold 6060h and 6061h.
        late_cycles: Cycles in a row that an axis may not answer.
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
        names: Sequence[str] = (),
        said: Callable[[Emergency], str] = lambda emergency: f"EMCY {emergency.code:04X}h",
    ) -> None:
        self._n, self._period_s, self._outputs = len(nodes), period_s, outputs
        self._mode_mapped, self._late_cycles, self._said = mode_mapped, late_cycles, said
        names = names or [f"axis {axis + 1}" for axis in range(len(nodes))]
        self._complaints = Complaints(names, nodes)
        self._codes = [0] * self._n
        self._missed = [0] * self._n
        self._calm: list[int] = []
        self._all_fresh = [True] * self._n
        self._states = [State.UNKNOWN] * self._n
        self._inputs = Inputs.none_yet(self._n)
        self._cycle = self._since = 0
        self._follows = [False] * self._n
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
        return self.phase in _RUNNING

    @property
    def complains(self) -> bool:
        """Whether there is a problem that is not told yet."""
        return bool(self._complaints)

    def enable(self, mode: int) -> None:
        """Begin to enable all axes in a mode; not while any is enabled."""
        self._complaints.clear()
        self.overdue = False
        self.mode = mode
        self._outputs.mode[:] = [mode] * self._n
        self._missed = [0] * self._n
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
        if self.phase is Phase.ENABLED and self._is_calm(inputs):
            return
        self._states = [state_of(word) for word in inputs.statusword]
        faulty = [code for code, s in zip(self._codes, self._states, strict=True) if s in _FAULTY]
        self.fault_code = faulty[0] if faulty else 0
        self._count_missed(inputs.fresh)
        if self.phase in _WATCHED:
            self._judge(inputs)
        self._go_on[self.phase](inputs)
        settled = self.phase is Phase.ENABLED and all(self._follows) and not any(self._missed)
        self._calm = inputs.statusword.copy() if settled else []

    def take_problem(self) -> str:
        """What made it stop all axes, with all axes' states; told once, empty else."""
        waited = self._cycle - self._complaints.since >= TOLD_AFTER_S / self._period_s
        if not self._complaints or not waited:
            return ""
        return self._complaints.take(self._states)

    # -- what may be wrong

    def _complain(self, axis: int | None, what: str) -> None:
        """Note it; stop all when anything is on."""
        if self.phase in _WATCHED:
            self._complaints.add(axis, what, self._cycle)
            self.quick_stop()
        elif self._complaints:
            self._complaints.add(axis, what, self._cycle)
        elif axis is not None:
            self._complaints.keep(axis, what)

    def _is_calm(self, inputs: Inputs) -> bool:
        """Nothing is other than when it was judged last."""
        return (
            inputs.statusword == self._calm
            and inputs.fresh == self._all_fresh
            and (not self._mode_mapped or inputs.mode_display == self._outputs.mode)
        )

    def _count_missed(self, fresh: list[bool]) -> None:
        self._missed = [
            0 if came else missed + 1 for came, missed in zip(fresh, self._missed, strict=True)
        ]

    def _judge(self, inputs: Inputs) -> None:
        for axis, state in enumerate(self._states):
            word = inputs.statusword[axis]
            if self._missed[axis] > self._late_cycles:
                self._complain(axis, f"has not answered {self._missed[axis]} SYNCs in a row")
            elif state in _FAULTY:
                self._complain(axis, told_by(word))
            elif self.running and state is not State.ENABLED:
                self._complain(axis, f"has left operation enabled: {told_by(word)}")
            elif self.phase is Phase.ENABLED:
                self._judge_following(axis, word, inputs)

    def _judge_following(self, axis: int, word: int, inputs: Inputs) -> None:
        if self._mode_mapped and inputs.mode_display[axis] != self.mode:
            self._complain(axis, f"has left mode {_mode(self.mode)} on its own")
        elif word & states.FOLLOWS_COMMAND:
            self._follows[axis] = True
        elif self._follows[axis] or self._for_s() > FOLLOWS_WITHIN_S:
            self._complain(axis, f"ignores set-points (bit 12 low): {told_by(word)}")

    # -- what comes next, by phase

    def _stay_off(self, inputs: Inputs) -> None:
        self._preload(range(self._n))
        self._steer(Goal.OFF)

    def _reset(self, inputs: Inputs) -> None:
        self._preload(range(self._n))
        words = self._outputs.controlword
        for axis, state in enumerate(self._states):
            words[axis] = controlword_resetting(state, words[axis])
        if not any(state in _FAULTY for state in self._states):
            self._enter(Phase.OFF)
        elif self._is_overdue():
            self._give_up([axis for axis in range(self._n) if self._states[axis] in _FAULTY])

    def _set_mode(self, inputs: Inputs) -> None:
        self._preload(range(self._n))
        self._steer(Goal.OFF)
        wrong = self._in_wrong_mode(inputs)
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
        wrong = self._in_wrong_mode(inputs)
        if not wrong:
            self._enter(Phase.ENABLED)
        elif self._is_overdue():
            self._give_up(wrong)

    def _brake(self, inputs: Inputs) -> None:
        """Quick stop until no axis carries current; silent ones may hear it all the same."""
        carrying = [axis for axis in range(self._n) if self._states[axis] in states.POWERED]
        answering = any(self._missed[axis] <= self._late_cycles for axis in carrying)
        given_s = WITHIN_S[Phase.BRAKING] if answering else SILENT_S
        if not carrying or self._for_s() > given_s:
            self._enter(Phase.OFF)
            self._steer(Goal.OFF)
        else:
            self._steer(Goal.QUICK_STOP)

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
        self._follows = [False] * self._n
        self._calm = []

    def _for_s(self) -> float:
        return (self._cycle - self._since) * self._period_s

    def _is_overdue(self) -> bool:
        return self._for_s() > WITHIN_S[self.phase]

    def _give_up(self, axes: list[int]) -> None:
        """A phase has taken too long because of these axes."""
        doing = self.phase.value
        for axis in axes:
            what = told_by(self._inputs.statusword[axis])
            if self.phase in (Phase.MODE, Phase.SWITCHING) and axis in self._in_wrong_mode(
                self._inputs
            ):
                shown = _mode(self._inputs.mode_display[axis])
                what = f"mode {_mode(self.mode)} was asked for, it shows {shown}; {what}"
            text = f"{doing} took longer than {WITHIN_S[self.phase]:g} s: {what}"
            self._complaints.add(axis, text, self._cycle)
        self.overdue = True
        self.quick_stop()

    def _in_wrong_mode(self, inputs: Inputs) -> list[int]:
        if not self._mode_mapped:
            return []
        return [axis for axis, mode in enumerate(inputs.mode_display) if mode != self.mode]

    def _steer(self, goal: Goal) -> None:
        self._outputs.controlword[:] = [controlword_towards(s, goal) for s in self._states]

    def _preload(self, axes: tuple[int, ...] | range) -> None:
        """Targets are where the axes are: nothing jumps when they are enabled."""
        outputs, inputs = self._outputs, self._inputs
        for axis in axes:
            outputs.target_position[axis] = inputs.position[axis]
            outputs.target_velocity[axis] = outputs.torque_offset[axis] = 0
            outputs.target_torque[axis] = 0


def _mode(mode: int) -> str:
    name = od.MODE_NAMES.get(mode)
    return f"{mode} ({name})" if name else str(mode)
