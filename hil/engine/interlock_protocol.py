"""What an interlock is, and what it says when it trips."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from hil.core import InterlockTripped, StructArray

Action = Literal["stop", "pause"]


@dataclass(frozen=True, slots=True)
class Trip:
    """Why motion was stopped.

    Attributes:
        interlock: Its name.
        joint: Index of the joint concerned, −1 when it is no joint's fault.
        value: What was found, NaN for what could not be measured.
        limit: What would have been allowed; both in `unit`.
        device_time: Of the sample [s].
        subject: What `value` is of, where it is not the joint's.
        least: Whether the value must be above the limit instead of below.
        lost: Whether what is not measured was measured before.
    """

    interlock: str
    joint: int
    value: float
    limit: float
    unit: str
    device_time: float
    subject: str = ""
    least: bool = False
    lost: bool = False

    def text(self, joint_names: Sequence[str]) -> str:
        """The trip in words."""
        what = self.subject or joint_names[self.joint]
        missing = "was measured, is not any more" if self.lost else "not measured"
        found = missing if math.isnan(self.value) else f"at {self.value:.4g} {self.unit}"
        bound = "at least" if self.least else "limit"
        return (
            f"interlock {self.interlock}: {what} {found}, {bound} {self.limit:.4g} {self.unit}, "
            f"device time {self.device_time:.3f} s"
        )

    def error(self, joint_names: Sequence[str]) -> InterlockTripped:
        """The trip as the error that ends the run."""
        return InterlockTripped(
            self.text(joint_names),
            hint="find the cause before running again; the data up to the trip is kept",
        )


@dataclass(frozen=True, slots=True)
class Margin:
    """How far a quantity is from its limit at one moment; for people, nothing is judged by it.

    Attributes:
        value, limit: In `unit`; of what is nearest to its limit.
        share: 1 where nothing is near, 0 at the limit and beyond.
        joint: Index of the joint concerned, −1 when it is no joint's.
        subject: What `value` is of, where it is not the joint's.
        least: Whether the value must be above the limit instead of below.
    """

    value: float
    limit: float
    unit: str
    share: float
    joint: int = -1
    subject: str = ""
    least: bool = False

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


@runtime_checkable
class HasMargin(Protocol):
    """An interlock that can also tell how far its quantity is from its limit."""

    def margin(self, block: StructArray) -> Margin | None:
        """For the last row of a block; None when nothing is known.

        Asked a few times a second on another thread than `check`, at the same time.
        """


class Interlock(Protocol):
    """One condition that must hold for every sample.

    A plug-in registered under `hil.interlocks` is called as `plugin(context, action=…, **own)`
    with the spec's other keys and returns one of these. What it raises ends the run.
    """

    @property
    def name(self) -> str:
        """Shown when it trips."""

    @property
    def action(self) -> Action:
        """What happens then; `pause` only where going on to the next checkpoint is safe."""

    def check(self, block: StructArray) -> Trip | None:
        """The first violation in the block, or None. Called for every block; must not wait."""

    def clear(self, block: StructArray) -> bool:
        """Whether every row is well inside the limit again; asked while the run is paused."""
