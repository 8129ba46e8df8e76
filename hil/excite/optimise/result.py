"""What an optimisation found, how good it is and how much of every limit it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from hil.excite.motion import FourierSeries
from hil.typing import FloatArray


@dataclass(frozen=True, slots=True)
class Progress:
    """How far an optimisation is.

    Attributes:
        start, starts: Number of the start at work, from 0, and of all starts.
        iteration: Of this start.
        value: Objective at this start's best feasible point so far.
        best: At the best feasible point of all starts so far; infinite while there is none.
        violation: Largest violation of a limit, as a share of that limit; of the clearance in m.
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
        drawn: Condition number of the draw (that of the objective; exp(−log_det/b) for log_det).
        value: Of its result; infinite when it found no feasible one.
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
    """

    position_rad: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    jerk: FloatArray | None = None
    effort: FloatArray | None = None
    clearance_m: float | None = None
    bodies: tuple[str, str] | None = None

    @property
    def feasible(self) -> bool:
        """Whether no limit is exceeded."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        raise NotImplementedError


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
        raise NotImplementedError
