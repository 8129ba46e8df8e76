"""What a check before motion is given and what it answers."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from hil.excitation import Clearance
from hil.planning import Plan
from hil.robot import Robot

Figure = float | str | None


@dataclass(frozen=True, slots=True)
class CheckResult:
    """The answer of one check.

    Attributes:
        name: Of the check, as in `waivers`.
        passed: False when the robot should not move.
        message: One sentence with the figures in it.
        measured, limit: What was found and what would have been fine, in SI units.
        hint: What to do about a failure.
        waived: True when a failure was accepted by name before the run.
        waivable: False when this failure may not be accepted, whoever says otherwise.
    """

    name: str
    passed: bool
    message: str
    measured: Figure = None
    limit: Figure = None
    hint: str = ""
    waived: bool = False
    waivable: bool = True

    @property
    def blocks(self) -> bool:
        """True when this result keeps the robot from moving."""
        return not (self.passed or self.waived)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "name": self.name,
            "passed": self.passed,
            "waived": self.waived,
            "message": self.message,
            "measured": _writable(self.measured),
            "limit": _writable(self.limit),
            "hint": self.hint,
        }


def _writable(figure: Figure) -> Figure:
    """The figure, or its name where JSON has no number for it."""
    return str(figure) if isinstance(figure, float) and not math.isfinite(figure) else figure


def _free_bytes(folder: Path) -> int:
    return shutil.disk_usage(folder).free


@dataclass(frozen=True, eq=False)
class Context:
    """What checks need to know beside plan and robot.

    Attributes:
        folder: Where the recording will be written; it exists.
        collision: Gives the distances of the arm with the plan's loads; None when nobody can.
        clearance_m: Distance that must be kept.
        waivers: Names of checks whose failure is accepted.
        now: Unix time of this host [s].
        free_bytes: Free space of the file system a folder lies on.
    """

    folder: Path
    collision: Callable[[Plan], Clearance] | None = None
    clearance_m: float = 0.0
    waivers: tuple[str, ...] = ()
    now: Callable[[], float] = time.time
    free_bytes: Callable[[Path], int] = field(default=_free_bytes)


@dataclass(frozen=True, eq=False)
class Situation:
    """What every check looks at: one plan, one robot, the robot's newest state row."""

    plan: Plan
    robot: Robot
    state: np.void
    context: Context


class Check(Protocol):
    """A check, built in or registered under `hil.checks`; its name is what it is registered as.

    It may read the robot but must not move it. What it raises counts as a failure.
    """

    def __call__(self, situation: Situation) -> CheckResult:
        """Look and answer; never raises for a mere failure."""
