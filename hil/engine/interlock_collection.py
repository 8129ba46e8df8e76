"""All interlocks of a run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, overload

from hil.engine.interlock_protocol import Interlock


class Off(NamedTuple):
    """An interlock of the spec that does not watch, and why."""

    name: str
    why: str


class Interlocks(Sequence[Interlock]):
    """The interlocks of a run; close them after it.

    Args:
        watching: In the order in which they are judged.
        stale_after_s: How long the robot's state may stand still [s]; the engine sees to that.
        off: What does not watch.
    """

    def __init__(
        self, watching: Sequence[Interlock], stale_after_s: float, off: Sequence[Off] = ()
    ) -> None:
        self._watching = tuple(watching)
        self.stale_after_s = stale_after_s
        self.off = tuple(off)

    @overload
    def __getitem__(self, index: int) -> Interlock: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[Interlock, ...]: ...

    def __getitem__(self, index: int | slice) -> Interlock | tuple[Interlock, ...]:
        return self._watching[index]

    def __iter__(self) -> Iterator[Interlock]:
        return iter(self._watching)

    def __len__(self) -> int:
        return len(self._watching)

    def describe(self) -> list[dict[str, str]]:
        """What watches and what does not: `{name, action, limit}`, and `why` where `action` is off.

        A plug-in's limit is its `watches`, if it has one.
        """
        rows = [
            {"name": one.name, "action": one.action, "limit": str(getattr(one, "watches", ""))}
            for one in self._watching
        ]
        rows.append({"name": "stale", "action": "stop", "limit": f"{self.stale_after_s:g} s"})
        return rows + [
            {"name": off.name, "action": "off", "limit": "", "why": off.why} for off in self.off
        ]

    def close(self) -> None:
        """End what runs beside the control thread. Idempotent."""
        for interlock in self._watching:
            close = getattr(interlock, "close", None)
            if close is not None:
                close()
