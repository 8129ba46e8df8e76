"""The two generations of controllers that are played: CB3 (the paper's UR5) and e-Series."""

from __future__ import annotations

from dataclasses import dataclass

from hil.core import SpecError


@dataclass(frozen=True, slots=True)
class Series:
    """What differs between generations.

    Attributes:
        name: `cb3` or `e`.
        version: Major, minor, bug-fix and build number of the controller software.
        date: Of that software, as it is told with the version.
        rate_hz: Ticks per second, also the highest RTDE rate [Hz].
        arms: Built-in arms that such a controller moves.
    """

    name: str
    version: tuple[int, int, int, int]
    date: str
    rate_hz: float
    arms: tuple[str, ...]

    @property
    def is_e(self) -> bool:
        """Whether it is an e-Series controller."""
        return self.version[0] >= 5

    def at_least(self, cb3: tuple[int, int] | None, e: tuple[int, int] | None) -> bool:
        """Whether its software has what came with these versions; None for never."""
        since = e if self.is_e else cb3
        return since is not None and self.version[:2] >= since


CB3 = Series("cb3", (3, 15, 8, 106339), "Apr 17 2022", 125.0, ("ur3", "ur5", "ur10"))
E_SERIES = Series("e", (5, 12, 2, 1101534), "Dec 02 2022", 500.0, ("ur3e", "ur5e", "ur10e"))


def series_of(arm: str) -> Series:
    """The controller that moves a built-in arm.

    Raises:
        SpecError: It is no arm of Universal Robots.
    """
    for series in (CB3, E_SERIES):
        if arm in series.arms:
            return series
    known = ", ".join(CB3.arms + E_SERIES.arms)
    raise SpecError(f"a UR controller moves no {arm}", hint=f"it moves {known}")
