"""What an optimisation found, how good it is and how much of every limit it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from hil.core import FloatArray
from hil.excitation.motion import FourierSeries

ROUNDING = 1e-9
"""Excess that counts as none."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far an optimisation is.

    Attributes:
        start, starts: Number of the start at work, from 0, and of all starts.
        iteration: Of this start.
        value: Objective (−log det for `log_det`) at this start's best point within all limits so
            far; infinite while there is none.
        best: At the best feasible point of all starts so far; infinite while there is none.
        violation: Largest excess over a limit where it is: a share of a torque limit, or of 0.1 m
            of clearance; the other limits are never exceeded.
        elapsed_s: Time since the beginning.
        eta_s: Time that is probably left, None where nothing can be said yet.
    """

    start: int
    starts: int
    iteration: int
    value: float
    best: float
    violation: float
    elapsed_s: float
    eta_s: float | None


ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True, slots=True)
class Start:
    """How one of several starts went.

    Attributes:
        seed: `[seed, number]` of its random draw.
        drawn: Objective of the draw: condition number, or −log det.
        value: Of its result; infinite where no motion within all limits was found.
        iterations: Solved quadratic programs.
        evaluations: Of the objective with its gradient.
        cpu_s: CPU time.
        ended: Why it ended: `converged`, `iterations`, `budget` or `infeasible`.
    """

    seed: tuple[int, int]
    drawn: float
    value: float
    iterations: int
    evaluations: int
    cpu_s: float
    ended: str


@dataclass(frozen=True, slots=True, eq=False)
class Margins:
    """What a series leaves of every limit, on a dense grid; negative where one is exceeded.

    Attributes:
        position_rad: (n,) to the nearer end of the position box.
        velocity, acceleration: (n,) share of the limit that is left.
        jerk, effort: (n,) the same, None where there is no limit.
        clearance_m: Distance beyond what is kept, None where it is not checked.
        bodies: Between which two bodies that is.
        space_m: Distance of the flange to the faces of its space beyond what is kept, None if it
            may go anywhere.
    """

    position_rad: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray | None = None
    effort: FloatArray | None = None
    clearance_m: float | None = None
    bodies: tuple[str, str] | None = None
    space_m: float | None = None

    @property
    def feasible(self) -> bool:
        """Whether no limit is exceeded."""
        shares = (self.velocity, self.acceleration, self.jerk, self.effort, self.position_rad)
        least = min(float(np.min(share)) for share in shares if share is not None)
        return min(least, self.clearance_m or 0.0, self.space_m or 0.0) >= -ROUNDING

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        out: dict[str, Any] = {}
        for name in ("position_rad", "velocity", "acceleration", "jerk", "effort"):
            value = getattr(self, name)
            out[name] = None if value is None else [float(x) for x in value]
        bodies = None if self.bodies is None else list(self.bodies)
        distances = {"clearance_m": self.clearance_m, "space_m": self.space_m}
        return out | distances | {"bodies": bodies}


@dataclass(frozen=True, slots=True, eq=False)
class Optimised:
    """The best series of all starts.

    Attributes:
        series: The motion.
        objective: Its value: a condition number, or the log determinant.
        condition_raw, condition_scaled: Of the base regressor together with earlier trajectories.
        margins: What it leaves of every limit.
        information: (b, b) triangle that stands for this and all earlier trajectories in the
            `earlier` of a further problem.
        starts: How each start went.
        cpu_s: CPU time of everything.
    """

    series: FourierSeries
    objective: float
    condition_raw: float
    condition_scaled: float
    margins: Margins
    information: FloatArray
    starts: tuple[Start, ...] = field(default=())
    cpu_s: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """JSON form, without `information`."""
        return {
            "series": self.series.to_dict(),
            "objective": self.objective,
            "condition_raw": self.condition_raw,
            "condition_scaled": self.condition_scaled,
            "margins": self.margins.to_dict(),
            "starts": [asdict(start) for start in self.starts],
            "cpu_s": self.cpu_s,
        }
