"""Optimise a Fourier trajectory from random starts by sequential quadratic programming.

The optimisation method follows Nocedal and Wright 2006, ch. 18. Every iterate of the optimisation
satisfies the linear limits. The nonlinear limits are elastic rows with one common excess, which is
penalised. The line search minimises the objective plus that penalty. The objective becomes sharper
from stage to stage (`hil.dynamics.log_condition`).

The quadratic program of a step contains only few of the many rows of limits: the peaks in time of
rows that are nearly reached, and rows that limited the last step. If a step would exceed rows
outside the quadratic program, these rows are added and the program is solved again (by Clarabel's
interior-point method).

A denser grid detects exceeded limits between the points of the optimisation grid. Each limit
exceeded on the denser grid is tightened by its excess, and the search continues.
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
"""Maximum number of repetitions of the last stage while its result exceeds limits between the grid
points.
"""

ITERATIONS = 200


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of an optimisation, passed to the progress callback.

    Attributes:
        start, starts: Number of the current start, from 0, and number of all starts.
        best: Objective at the best feasible point of all starts so far; infinite if there is no
            feasible point yet.
        eta_s: Estimated remaining time of the optimisation [s], None if no estimate is possible
            yet.
    """

    start: int
    starts: int
    best: float
    eta_s: float | None


ProgressCallback = Callable[[Progress], None]


@dataclass(frozen=True, slots=True)
class Start:
    """Result of one random start of an optimisation.

    Attributes:
        seed: Pair `[seed, number]` from which the start motion was drawn.
        drawn: Objective of the drawn start motion: condition number, or −log det.
        value: Objective of the optimised motion; infinite if no motion within all limits was found.
        iterations: Number of accepted steps.
        evaluations: Number of evaluations of the objective with its gradient.
        cpu_s: CPU time.
        ended: Reason for the end of the search: `converged`, `iterations`, `budget` or
            `infeasible`.
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
    """Best series of all starts of an optimisation.

    Attributes:
        series: Optimised motion.
        objective: Value of the objective for the best series: a condition number, or the log
            determinant.
        condition_raw, condition_scaled: Condition numbers of the base regressor of this and all
            earlier trajectories.
        margins: Margins of the series to every limit.
        information: (b, b) triangle with the information of this and all earlier trajectories, to
            be passed as `earlier` to the next problem.
        starts: Results of all random starts.
        cpu_s: CPU time of all starts together [s].
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
        """Return the optimisation result as a JSON object, without `information`."""
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
    """Return the best of several local optima of an excitation problem.

    Args:
        problem: Excitation problem to solve.
        starts: Number of random starts.
        seed: Seed of the random starts; the same seed gives the same series.
        progress: Callback that receives the progress after every step; an exception raised by the
            callback stops the search.
        cpu_s: CPU time limit for all starts together [s]. After the CPU time limit, the search ends
            with the best series so far. The series of a search ended by the CPU time limit depends
            on the computer.
        iterations: Maximum number of iterations of one start.

    Raises:
        PlanError: No start found a motion within all limits; the message names the exceeded limit.
    """
    from threadpoolctl import threadpool_limits

    begun = time.process_time()
    tale = _Tale(starts, iterations, progress)
    done: list[tuple[Start, FloatArray]] = []
    with threadpool_limits(1):  # threads do not pay off for small matrices
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
        hint=("allow more time, " if spent else "")
        + "widen the limits, lower the clearance, or use more starts or another seed",
    )


class _Tale:
    """Progress of all starts, reported to the progress callback."""

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
    """Search from one random start, from its draw to a motion within all limits."""

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
        """Run all stages of the search; return the result of the start and its best motion.

        If no motion of the search is within all limits, the last motion is returned.
        """
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
        """Store the best motion if it satisfies all limits between the grid points, too.

        If the best motion exceeds limits between the grid points, tighten these limits by their
        excess, so that the search can continue.
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
"""Factors by which a drawn start motion is scaled; the largest is tried first, and the optimisation
can enlarge a small motion.
"""


def draw(
    linear: LinearLimits,
    others: MotionLimits,
    rng: np.random.Generator,
    centres: FloatArray | None = None,
) -> FloatArray:
    """Return free coefficients (n, f) of a random motion within the linear limits.

    The first of at most `DRAWS` draws that satisfies the nonlinear limits is returned. If no draw
    satisfies the nonlinear limits, the draw with the smallest excess is returned.

    Args:
        linear: Linear limits of the problem.
        others: Nonlinear limits of the problem.
        rng: Random generator.
        centres: (m, n) poses from which the centre of every draw is taken; None for random centres.
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
    """Return free coefficients (n, f) of a random series of 70 to 100 % of its largest size."""
    free = rng.standard_normal(linear.free_shape)
    free *= (linear.largest_scale(free) * rng.uniform(0.7, 1.0, len(free)))[:, None]
    free[:, 0] = rng.uniform(*linear.centres(free))
    return free


ARMIJO = 1e-4
SHORTEST = 1e-3
FLAT = -1e-9
SMALL = 2e-4

PATIENCE = 3
"""Number of consecutive steps after which a stage ends, if each of them improves the logarithm of
the objective by less than `SMALL`.
"""

MOST_EXCESS = 0.1
"""Maximum excess that a step may lead to, unless the excess was larger before the step. The excess
is restricted because the gradient of deeply overlapping bodies does not lead out of the overlap.
"""

FIRST_PENALTY = 10.0
"""Initial penalty for an excess of 1 over the nonlinear limits. The initial penalty is raised if it
is too small to reduce the excess to zero.
"""

NEAR_EXCESS = -1.0
"""Excess above which the peaks in time of the nonlinear limits are part of the first quadratic
program.
"""

TOUCHING = -0.25
"""Excess above which every row of the nonlinear limits is part of the first quadratic program."""

MOST_ELASTIC = 200
"""Maximum number of rows of the nonlinear limits in one quadratic program; the rows with the
largest excess are used.
"""

ALLOWED = 1e-6
"""Excess that is treated as zero; the check on the denser grid detects a larger excess."""

ACTIVE = 1e-7
"""Lagrange multiplier below which a row of the quadratic program is treated as inactive."""

NEAR = 0.1
"""Slack below which a row of the linear limits is part of the first quadratic program, as a
share of the limit."""

SOLVED = 10
"""Maximum number of quadratic programs that are solved for one step."""


class StepProgram:
    """Quadratic program of a step, with the state that is retained from step to step.

    The retained state consists of the Hessian, the active rows of the linear limits and the
    penalty.

    Args:
        linear: Linear limits, which are satisfied after every step.
        others: Nonlinear limits, which may be exceeded until the search converges.
    """

    def __init__(self, linear: LinearLimits, others: MotionLimits) -> None:
        self._linear, self._others = linear, others
        self._scale = linear.unit()
        self._hessian = np.eye(len(self._scale))
        self._held = np.empty(0, dtype=np.int64)
        self.penalty = FIRST_PENALTY

    def propose(self, point: Point) -> Proposal | None:
        """Return the proposed next step, or None if the solver fails."""
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
        """Update the Hessian of the objective and of the elastic rows along the accepted step."""
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
    """Search for a local optimum from one random start.

    Attributes:
        linear, others: Linear and nonlinear limits of the problem.
        value_of: Objective function of the problem.
        free: (n, f) current free coefficients, within the linear limits.
        told: Callback that is called after every step of the search.
        deadline: CPU time at which the search ends [s].
        best: Best point within all limits so far, None if there is no such point yet.
        best_value: Objective at the best point; infinite if there is no such point yet.
        iterations: Number of steps of the search so far.
        ended: Reason for the end of the last stage.
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
        """Discard the best point after a change of the limits; it may exceed them now."""
        if self.best is not None:
            self.free = self.best
        self.best, self.best_value = None, np.inf

    def run(self, sharpness: float, iterations: int) -> None:
        """Run one stage of the search with at most `iterations` steps."""
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
        """Return the point at `free`, and store this point if it is the best so far."""
        point = Point(free, self.value_of(free, sharpness), self.others.excess(free))
        if point.violation <= TOLERATED and point.value.exact < self.best_value:
            self.best, self.best_value = free, point.value.exact
        return point

    def _next(self, point: Point, sharpness: float) -> Point | None:
        """Return the next point, or None if no step improves the merit function."""
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
        """Return a point along the step that improves the merit function within the linear limits.

        Return None if no point along the step improves the merit function.
        """
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
            # Minimum of the parabola through both values and the slope.
            lowest = -0.5 * slope * share / (change - slope * share)
            share *= 0.5 if worse else float(np.clip(lowest, 0.1, 0.5))
        return None

    def _allowed_share(self, free: FloatArray, move: FloatArray) -> float:
        slack, change = self.linear.slack(free), self.linear.change(move)
        least = np.min(np.where(change > ALLOWED, slack / np.maximum(change, ALLOWED), 1.0))
        return float(np.clip(least, 0.0, 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Point of a search.

    Attributes:
        free: (n, f) coefficients.
        value: Value of the objective at the point.
        excess: (R, N) excess of the nonlinear limits at the point.
    """

    free: FloatArray
    value: Value
    excess: FloatArray

    @property
    def violation(self) -> float:
        """Largest excess over the nonlinear limits; 0 if no limit is exceeded."""
        return float(self.excess.max(initial=0.0))

    def merit(self, penalty: float) -> float:
        """Return the objective plus the penalty times the largest excess."""
        return self.value.value + penalty * self.violation


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """Solution of the quadratic program of one step.

    Attributes:
        move: (v,) solution vector of the scaled variables.
        excess: Common excess of the elastic rows that remains after the step, at least 0.
        hard, elastic: Lagrange multipliers of the hard and the elastic rows.
    """

    move: FloatArray
    excess: float
    hard: FloatArray
    elastic: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """Step from a point that the quadratic program proposes.

    Attributes:
        move: (n, f) change of the free coefficients.
        slope: Slope of the merit function along the step, at its beginning.
        step: Solution of the quadratic program of the step.
        numbers: Row numbers of the nonlinear limits in the quadratic program.
        rows: Derivatives of the rows `numbers`, scaled like the variables of the solver.
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
        hessian: (v, v) matrix H, positive definite.
        gradient: (v,) vector g.
        hard: Matrix A and vector b.
        elastic: Matrix C and vector c.
        penalty: Penalty factor of the common excess t.

    Returns:
        Solution of the quadratic program, or None if the solver fails.
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
    """Return the BFGS update of a Hessian; the updated Hessian stays positive definite.

    The BFGS update is damped after Powell 1978 if the curvature along the step is not positive.

    Args:
        hessian: (v, v) current approximation.
        way: (v,) step.
        turned: (v,) change of the gradient along the step.
    """
    along = hessian @ way
    old, new = float(way @ along), float(way @ turned)
    if not old > 0:
        return hessian
    share = 1.0 if new >= 0.2 * old else 0.8 * old / (old - new)
    mixed = share * turned + (1.0 - share) * along
    return hessian + np.outer(mixed, mixed) / (way @ mixed) - np.outer(along, along) / old
