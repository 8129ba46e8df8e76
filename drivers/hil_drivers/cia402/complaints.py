"""What is wrong with which axis, gathered until it is told in one message."""

from __future__ import annotations

from collections.abc import Sequence

from hil_drivers.cia402.states import State

STOPPED = "All axes were stopped"
TOLD = "All axes were told to stop"
UNKNOWN = "not known to have stopped"
NOBODY = (
    "No axis answers: quick stop may not arrive, but without a master drives stop by themselves"
)
_MOVING = (None, State.ENABLED, State.UNKNOWN)
"""States in which nothing says that an axis brakes or is off; None: it does not answer."""


class Complaints:
    """What made all axes stop, and what else came of it.

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
        """Begin anew; what was only kept is kept."""
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
        """Something that stops nothing now, and may explain what comes."""
        self._before[axis] = what

    def forget(self, axis: int) -> None:
        """It says that its errors are gone."""
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
        """What has become of the axes; nobody is said to have stopped who does not say so."""
        if not any(states):
            return NOBODY
        moving = [axis for axis, state in enumerate(states) if state in _MOVING]
        others: dict[str, list[str]] = {}
        for axis, state in enumerate(states):
            if state is not None and axis not in moving and axis not in self._of_axes:
                others.setdefault(state.value, []).append(self._names[axis])
        if moving:
            others[UNKNOWN] = [self._names[axis] for axis in moving]
        by_state = [f"{', '.join(names)}: {state}" for state, names in others.items()]
        return "; ".join([TOLD if moving else STOPPED, *by_state]) if by_state else ""
