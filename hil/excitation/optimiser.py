"""Optimise a Fourier trajectory: random starts, each improved by sequential quadratic programming.

Nocedal and Wright 2006, ch. 18. Linear limits are kept by every iterate; the others are elastic
rows with one common excess that is penalised, and a line search looks at the objective plus that
penalty. The objective grows sharper from stage to stage (`hil.dynamics.log_condition`).

The quadratic program of a step holds few of the many rows of limits: those nearly reached, peaks
in time only, and those that held the last step back. Rows that a step would overstep join it, and
it is solved again (by Clarabel's interior-point method).

What exceeds a limit between the points of the grid is found on a denser one: it is taken off that
limit, and the search goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from hil.core import FloatArray, IntArray, PlanError
from hil.dynamics import conditioning
from hil.excitation.motion import FourierSeries
from hil.excitation.problem import (
    DENSER,
    RESERVE,
    TOLERATED,
    ExcitationProblem,
    LinearLimits,
    Margins,
    MotionLimits,
    Value,
    ValueOf,
    margins_of,
    peaks,
)

ROUNDS = 5
"""More of the last stage, while what it finds exceeds limits between the points."""

ITERATIONS = 200


@dataclass(frozen=True, slots=True)
class Progress:
    """How far an optimisation is.

    Attributes:
        start, starts: Number of the start at work, from 0, and of all starts.
        best: At the best feasible point of all starts so far; infinite while there is none.
        eta_s: Time that is probably left, None where nothing can be said yet.
    """

    start: int
    starts: int
    best: float
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


def optimise(
    problem: ExcitationProblem,
    *,
    starts: int = 3,
    seed: int = 0,
    progress: ProgressCallback | None = None,
    cpu_s: float = 60.0,
    iterations: int = ITERATIONS,
) -> Optimised:
    """The best of several local optima.

    Args:
        problem: What is asked for.
        starts: Number of random starts.
        seed: Of the starts; the same seed gives the same series.
        progress: Told now and then how far it is; may raise to stop the search.
        cpu_s: CPU time for all starts. When it is spent the search ends with what it has, which
            then depends on the computer.
        iterations: Of one start at most.

    Raises:
        PlanError: No start found a motion within all limits; says which limit is in the way.
    """
    from threadpoolctl import threadpool_limits

    begun = time.process_time()
    tale = _Tale(starts, iterations, progress)
    done: list[tuple[Start, FloatArray]] = []
    with threadpool_limits(1):  # matrices are small: threads would only wait for each other
        for number in range(max(1, starts)):
            if number and time.process_time() > begun + cpu_s:
                break
            one = _Attempt(problem, (seed, number), iterations, begun + cpu_s, tale)
            done.append(one.run())
            tale.ended(done[-1][0].value)
        best, free = min(done, key=lambda pair: pair[0].value)
        if np.isfinite(best.value):
            starts_done = tuple(start for start, _ in done)
            return _result(problem, free, starts_done, time.process_time() - begun)
    spent = time.process_time() > begun + cpu_s
    raise PlanError(
        f"no Fourier series was found within all limits, from {len(done)} random starts"
        + (f" in {cpu_s:g} s of CPU time: " if spent else ": ")
        + (MotionLimits(problem).complaint(free) or "limits are exceeded between the points"),
        hint=("give it more time, or " if spent else "give it ")
        + "more room: wider limits, less clearance, more starts or another seed",
    )


class _Tale:
    """What the progress callback is told."""

    def __init__(self, starts: int, iterations: int, progress: ProgressCallback | None) -> None:
        self._starts, self._iterations, self._progress = starts, iterations, progress
        self._begun, self._number, self._best = time.monotonic(), 0, np.inf

    def begins(self, number: int) -> None:
        self._number = number

    def ended(self, value: float) -> None:
        self._best = min(self._best, value)

    def step(self, search: Search) -> None:
        if self._progress is None:
            return
        elapsed = time.monotonic() - self._begun
        share = min(search.iterations / self._iterations, 1.0)
        done = (self._number + share) / self._starts
        self._progress(
            Progress(
                start=self._number,
                starts=self._starts,
                best=min(self._best, search.best_value),
                eta_s=elapsed * (1.0 - done) / done if done else None,
            )
        )


class _Attempt:
    """One start, from its draw to a motion within all limits."""

    def __init__(
        self,
        problem: ExcitationProblem,
        seed: tuple[int, int],
        iterations: int,
        deadline: float,
        tale: _Tale,
    ) -> None:
        self._problem, self._seed, self._iterations = problem, seed, iterations
        self._value_of, self._others = ValueOf(problem), MotionLimits(problem)
        linear, rng = LinearLimits(problem), np.random.default_rng(seed)
        free = draw(linear, self._others, rng, problem.centres)
        self._found: FloatArray | None = None
        self._value = np.inf
        tale.begins(seed[1])
        self._search = Search(linear, self._others, self._value_of, free, tale.step, deadline)

    def run(self) -> tuple[Start, FloatArray]:
        """How it went, and the best motion: where none is within limits, the last one."""
        begun = time.process_time()
        search, stages = self._search, self._value_of.stages
        drawn = self._value_of(search.free, stages[-1]).exact
        for stage, sharpness in enumerate(stages):
            left = self._iterations - search.iterations
            search.run(sharpness, -(-left // (len(stages) - stage)))
            self._check()
        for _ in range(ROUNDS):
            if search.best is not None or search.ended == "budget":
                break
            search.run(stages[-1], max(10, self._iterations // 6))
            self._check()
        start = Start(
            seed=self._seed,
            drawn=drawn,
            value=self._value,
            iterations=search.iterations,
            evaluations=self._value_of.evaluations,
            cpu_s=time.process_time() - begun,
            ended="infeasible" if self._found is None else search.ended,
        )
        return start, search.free if self._found is None else self._found

    def _check(self) -> None:
        """Keep the best motion if it is within all limits between the points, too.

        If not, take off the limits what it exceeds them by, and let the search go on from there.
        """
        search, others = self._search, self._others
        if search.best is None or search.best_value >= self._value:
            return
        exceeded = others.exceeded(search.best, DENSER)
        if not np.any(exceeded > 0):
            self._found, self._value = search.best, search.best_value
            return
        others.reserve += np.where(exceeded > 0, exceeded + RESERVE, 0.0)
        search.forget()


def _result(
    problem: ExcitationProblem, free: FloatArray, starts: tuple[Start, ...], cpu_s: float
) -> Optimised:
    series = problem.basis.series(free, problem.periods)
    information = problem.information(series)
    condition = conditioning(information)
    log_det = 2.0 * float(np.log(np.abs(np.diag(information))).sum())
    by_objective = condition.scaled if problem.scaled else condition.raw
    return Optimised(
        series=series,
        objective=by_objective if problem.objective == "condition" else log_det,
        condition_raw=condition.raw,
        condition_scaled=condition.scaled,
        margins=margins_of(problem, series),
        information=information,
        starts=starts,
        cpu_s=cpu_s,
    )


DRAWS = 40

SHRINKAGE = (1.0, 0.7, 0.5, 0.3, 0.15)
"""Tried from the largest; a small motion has room to grow while it is improved."""


def draw(
    linear: LinearLimits,
    others: MotionLimits,
    rng: np.random.Generator,
    centres: FloatArray | None = None,
) -> FloatArray:
    """(n, f) free coefficients of a motion.

    Where limits besides the linear ones are given: the first draw that keeps them, or that of
    `DRAWS` that exceeds them least. With `centres` (m, n) every draw is about one of them.
    """
    best, least = np.empty(0), np.inf
    for _ in range(DRAWS):
        free = within_linear_limits(linear, rng)
        centre = None if centres is None else rng.choice(centres)
        for share in SHRINKAGE:
            smaller = free * np.r_[1.0, np.full(free.shape[1] - 1, share)]
            if centre is not None:
                smaller[:, 0] = np.clip(centre, *linear.centres(smaller))
            excess = float(others.excess(smaller).max(initial=-np.inf))
            if excess < least:
                best, least = smaller, excess
            if least <= 0:
                return best
    return best


def within_linear_limits(linear: LinearLimits, rng: np.random.Generator) -> FloatArray:
    """(n, f): a random series per joint, 70 to 100 % of the largest its limits allow."""
    free = rng.standard_normal(linear.free_shape)
    free *= (linear.largest_scale(free) * rng.uniform(0.7, 1.0, len(free)))[:, None]
    free[:, 0] = rng.uniform(*linear.centres(free))
    return free


ARMIJO = 1e-4
SHORTEST = 1e-3
FLAT = -1e-9
SMALL = 2e-4

PATIENCE = 3
"""A stage ends after so many steps in a row that each better the logarithm by less than `SMALL`."""

MOST_EXCESS = 0.1
"""No step leads to more than this, or to more than there was: bodies deep in each other have no
slope that leads out again."""

FIRST_PENALTY = 10.0
"""Of an excess of 1; raised where it is too little to bring the excess to nothing."""

NEAR_EXCESS = -1.0
"""Excess above which a peak in time of the other limits joins the program from the first."""

TOUCHING = -0.25
"""Excess above which every row of the other limits does, peak or not."""

MOST_ELASTIC = 200
"""Rows of the other limits in one program: the worst ones."""

ALLOWED = 1e-6
"""Excess that counts as none; what is beyond is caught on the denser grid."""

ACTIVE = 1e-7
"""Multipliers below it are none."""

NEAR = 0.1
"""Share of a limit below which a row is handed to the solver from the first."""

SOLVED = 10
"""Programs for one step at most."""


class StepProgram:
    """What is kept from one step to the next: curvature, rows that held it back, penalty.

    Args:
        linear: Limits that every step keeps.
        others: Limits that steps approach.
    """

    def __init__(self, linear: LinearLimits, others: MotionLimits) -> None:
        self._linear, self._others = linear, others
        self._scale = linear.unit()
        self._hessian = np.eye(len(self._scale))
        self._held = np.empty(0, dtype=np.int64)
        self.penalty = FIRST_PENALTY

    def propose(self, point: Point) -> Proposal | None:
        """The next step, or None where the solver fails."""
        near = np.flatnonzero(point.excess > TOUCHING)
        numbers = np.union1d(near, peaks(-point.excess, -NEAR_EXCESS))
        worst = np.argsort(-point.excess.ravel()[numbers], kind="stable")[:MOST_ELASTIC]
        numbers = numbers[worst]
        rows = self._others.rows(point.free, numbers) * self._scale
        step = self._solve(point, (rows, -point.excess.ravel()[numbers]))
        if step is None:
            return None
        pull = float(step.elastic.sum())
        if pull > 0.5 * self.penalty and step.excess < ALLOWED:
            self.penalty = 2.0 * pull
        move = self._move(step)
        slope = float(point.value.gradient @ move.ravel())
        slope -= self.penalty * (point.violation - step.excess)
        return Proposal(move, slope, step, numbers, rows)

    def learn(self, taken: Proposal, point: Point, following: Point) -> None:
        """Curvature of the objective and of the elastic rows along the way taken."""
        multipliers = taken.step.elastic
        active = multipliers > ACTIVE
        way = (following.free - point.free).ravel() / self._scale
        turned = (following.value.gradient - point.value.gradient) * self._scale
        if np.any(active):
            after = self._others.rows(following.free, taken.numbers[active]) * self._scale
            turned = turned + multipliers[active] @ (after - taken.rows[active])
        self._hessian = damped_update(self._hessian, way, turned)

    def _solve(self, point: Point, elastic: tuple[FloatArray, FloatArray]) -> Step | None:
        slack = self._linear.slack(point.free)
        gradient = point.value.gradient * self._scale
        work = np.union1d(self._held, peaks(slack, NEAR))
        step: Step | None = None
        for _ in range(SOLVED):
            hard = self._linear.rows(work) * self._scale, slack.ravel()[work]
            step = solve_step(self._hessian, gradient, hard, elastic, self.penalty)
            if step is None:
                break
            self._held = work[step.hard > ACTIVE]
            left = slack - self._linear.change(self._move(step))
            overstepped = np.setdiff1d(peaks(left, -ALLOWED), work)
            if not len(overstepped):
                break
            work = np.union1d(work, overstepped)
        return step

    def _move(self, step: Step) -> FloatArray:
        return (step.move * self._scale).reshape(self._linear.free_shape)


@dataclass
class Search:
    """One start.

    Attributes:
        linear, others: The limits.
        value_of: The objective.
        free: (n, f) where it is, within the linear limits.
        told: Called after every step.
        deadline: CPU time at which to end [s].
        best: Best point within all limits so far, None before the first one.
        best_value: The objective there; infinite before.
        iterations: Steps so far.
        ended: Why the last stage ended.
    """

    linear: LinearLimits
    others: MotionLimits
    value_of: ValueOf
    free: FloatArray
    told: Callable[[Search], None] = lambda _: None
    deadline: float = np.inf
    best: FloatArray | None = None
    best_value: float = np.inf
    iterations: int = 0
    ended: str = "iterations"
    _program: StepProgram = field(init=False)

    def __post_init__(self) -> None:
        self._program = StepProgram(self.linear, self.others)

    def forget(self) -> None:
        """The limits have changed: what was best may not be allowed any more."""
        if self.best is not None:
            self.free = self.best
        self.best, self.best_value = None, np.inf

    def run(self, sharpness: float, iterations: int) -> None:
        """One stage."""
        point: Point | None = self._at(self.free, sharpness)
        slow = 0
        self.ended = "iterations"
        for _ in range(iterations):
            if time.process_time() > self.deadline:
                self.ended = "budget"
                return
            assert point is not None
            before = point.merit(self._program.penalty)
            point = self._next(point, sharpness)
            if point is not None:
                gain = before - point.merit(self._program.penalty)
                slow = slow + 1 if gain < SMALL else 0
            if point is None or slow >= PATIENCE:
                self.ended = "converged"
                return

    def _at(self, free: FloatArray, sharpness: float) -> Point:
        """Also notes the point where it is the best one so far."""
        point = Point(free, self.value_of(free, sharpness), self.others.excess(free))
        if point.violation <= TOLERATED and point.value.exact < self.best_value:
            self.best, self.best_value = free, point.value.exact
        return point

    def _next(self, point: Point, sharpness: float) -> Point | None:
        """The next point, or None where no step betters the merit."""
        proposal = self._program.propose(point)
        if proposal is None:
            return None
        following = self._search_along(proposal, point, sharpness)
        if following is None:
            return None
        self._program.learn(proposal, point, following)
        self.free = following.free
        self.iterations += 1
        self.told(self)
        return following

    def _search_along(self, proposal: Proposal, point: Point, sharpness: float) -> Point | None:
        """As far along the step as the merit becomes better and no linear limit is overstepped."""
        if proposal.slope > FLAT:
            return None
        share = self._allowed_share(point.free, proposal.move)
        penalty, slope = self._program.penalty, proposal.slope
        while share > SHORTEST:
            trial = self._at(point.free + share * proposal.move, sharpness)
            change = trial.merit(penalty) - point.merit(penalty)
            worse = trial.violation > max(MOST_EXCESS, point.violation)
            if change <= ARMIJO * share * slope and not worse:
                return trial
            # The least point of the parabola through both values and the slope.
            lowest = -0.5 * slope * share / (change - slope * share)
            share *= 0.5 if worse else float(np.clip(lowest, 0.1, 0.5))
        return None

    def _allowed_share(self, free: FloatArray, move: FloatArray) -> float:
        slack, change = self.linear.slack(free), self.linear.change(move)
        least = np.min(np.where(change > ALLOWED, slack / np.maximum(change, ALLOWED), 1.0))
        return float(np.clip(least, 0.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Where a search is: coefficients (n, f), the objective there, the excess (R, N) of limits."""

    free: FloatArray
    value: Value
    excess: FloatArray

    @property
    def violation(self) -> float:
        """Largest excess, 0 for none."""
        return float(self.excess.max(initial=0.0))

    def merit(self, penalty: float) -> float:
        """Objective plus penalty."""
        return self.value.value + penalty * self.violation


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """A solution.

    Attributes:
        move: (v,).
        excess: What no step can mend of the elastic rows, at least 0.
        hard, elastic: Multipliers of the rows.
    """

    move: FloatArray
    excess: float
    hard: FloatArray
    elastic: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """A step from a point.

    Attributes:
        move: (n, f).
        slope: Of the merit along it at its beginning.
        step: The program's solution.
        numbers: Rows of the other limits it looked at.
        rows: Their derivatives, scaled as the solver's variables.
    """

    move: FloatArray
    slope: float
    step: Step
    numbers: IntArray
    rows: FloatArray


TOLERANCE = 1e-8


def solve_step(
    hessian: FloatArray,
    gradient: FloatArray,
    hard: tuple[FloatArray, FloatArray],
    elastic: tuple[FloatArray, FloatArray],
    penalty: float,
) -> Step | None:
    """Minimise gᵀd + dᵀHd/2 + penalty·t with A d ≤ b, C d ≤ c + t and t ≥ 0.

    Args:
        hessian: (v, v), positive definite.
        gradient: (v,).
        hard: A and b.
        elastic: C and c.
        penalty: Of t.

    Returns:
        None where the solver does not succeed.
    """
    import clarabel
    import scipy.sparse

    (A, b), (C, c) = hard, elastic
    size, soft = len(gradient), int(len(c) > 0)
    H = np.zeros((size + soft, size + soft))
    H[:size, :size] = np.triu(hessian)
    rows = np.zeros((len(b) + len(c) + soft, size + soft))
    rows[: len(b), :size], rows[len(b) : len(b) + len(c), :size] = A, C
    if soft:
        H[size, size] = 1e-9 * penalty
        rows[len(b) :, size] = -1.0
    bounds = np.concatenate([b, c, np.zeros(soft)])
    costs = np.concatenate([gradient, np.full(soft, penalty)])
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = TOLERANCE
    cones = [clarabel.NonnegativeConeT(len(bounds))]
    found = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix(H), costs, scipy.sparse.csc_matrix(rows), bounds, cones, settings
    ).solve()
    if str(found.status) not in ("Solved", "AlmostSolved"):
        return None
    x, multipliers = np.array(found.x), np.array(found.z)
    excess = float(max(x[size], 0.0)) if soft else 0.0
    return Step(x[:size], excess, multipliers[: len(b)], multipliers[len(b) : len(b) + len(c)])


def damped_update(hessian: FloatArray, way: FloatArray, turned: FloatArray) -> FloatArray:
    """BFGS from a way (v,) and the change of the gradient along it; stays positive definite.

    Damped as by Powell 1978 where the curvature along the way is not positive.
    """
    along = hessian @ way
    old, new = float(way @ along), float(way @ turned)
    if not old > 0:
        return hessian
    share = 1.0 if new >= 0.2 * old else 0.8 * old / (old - new)
    mixed = share * turned + (1.0 - share) * along
    return hessian + np.outer(mixed, mixed) / (way @ mixed) - np.outer(along, along) / old
