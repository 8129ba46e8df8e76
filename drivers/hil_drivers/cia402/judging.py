"""Whether the drives are as they are to be: from one cycle's answers, axis by axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from hil_drivers.cia402 import objects as od
from hil_drivers.cia402 import states
from hil_drivers.cia402.contracts import Inputs
from hil_drivers.cia402.phases import RUNNING, Phase
from hil_drivers.cia402.states import State, told_by

FOLLOWS_WITHIN_S = 0.1
"""How long after enabling or switching bit 12 may stay low [s]."""

BEHIND_TIMES = 3
"""Times `late_cycles` for which an axis may be behind: its answers come, but to older SYNCs."""

FAULTY = (State.FAULT, State.FAULT_REACTION)


class Judge:
    """What is wrong with which axis.

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
        """All that follows from these answers has been done: are they what is to stay?"""
        well = phase is Phase.ENABLED and all(self._follows) and not any(self._behind)
        self._calm = inputs.statusword.copy() if well else []

    def judge(
        self, inputs: Inputs, found: Sequence[State], phase: Phase, mode: int, for_s: float
    ) -> Iterator[tuple[int, str]]:
        """Axes that are not as they are to be, and what is wrong.

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
                yield axis, told_by(word)
            elif phase in RUNNING and state is not State.ENABLED:
                yield axis, f"has left operation enabled: {told_by(word)}"
            elif phase is Phase.ENABLED and self._is_in_wrong_mode(axis, inputs, mode):
                yield axis, f"has left mode {mode_text(mode)} on its own"
            elif phase is Phase.ENABLED and not self._follows_now(axis, word, for_s):
                yield axis, f"ignores set-points (bit 12 low): {told_by(word)}"

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
        if word & states.FOLLOWS_COMMAND:
            self._follows[axis] = True
            return True
        return not self._follows[axis] and for_s <= FOLLOWS_WITHIN_S


def mode_text(mode: int) -> str:
    """A mode of operation for messages."""
    name = od.MODE_NAMES.get(mode)
    return f"{mode} ({name})" if name else str(mode)
