"""Payload check: is the load that is mounted the load declared? Judged before anything is measured.

The engine passes on the settled rows of every dwell (`Engine(..., measured=check.measured)`). At
each weighing pose the arm rests twice, approached from below and from above: the mean of the two is
the torque, half their difference the friction (`combined_reading`). What a load adds to the torques
of the first one at the same poses is compared with what the declared loads would add, so that
friction and model errors of the arm cancel (`compare_loads`). The first load itself is not checked.
A `LoadVerdict` has the result for operators and for the event log; a load that is not the declared
one stops the run, unless that was waived.

A resumed run takes the weighing of its first load from the recordings of earlier attempts
(`readings_of_earlier_attempts`). A weighing counts if its attempt went on to measure: one that was
refused, or given up, says nothing about the load of the measurements.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from hil.arms import Payload
from hil.core import DataError, FloatArray, PreflightFailed, StructArray
from hil.dynamics import Balance, load_model, static_columns, static_parameters
from hil.importers import recorded_steps, step_is_complete
from hil.planning import Plan, Step, is_sweep, why_plan_not_weighed
from hil.robot import Capabilities, Status
from hil.spec import Weigh

if TYPE_CHECKING:
    from hil.dynamics import RobotModel, Weighed


CHECK = "weighing"
"""Name of the check in preflight and of its waiver, and kind of its events."""

HINT = (
    "mount the load that is declared, the way round it is declared; correct `loads` in the spec; "
    f'or run all the same: --waive "{CHECK}=REASON"'
)

AGAIN_HINT = (
    "mount load 0 as it was when it was measured, and resume again; if it was another load then, "
    f'run the experiment anew; or go on all the same: --waive "{CHECK}=REASON"'
)
"""For a first load that is not what it was in an earlier attempt."""


class RecordEvent(Protocol):
    """Records results; a sink's `event`."""

    def __call__(self, kind: str, **details: Any) -> object:
        """Record an event."""


class PayloadCheck:
    """Checks the loads of one run; records at the beginning if it will not.

    Args:
        plan: Of the whole run.
        gravity: (3,) in the base frame [m/s²].
        robot: With the kind of its efforts and its drive gains.
        tolerance: Of the spec; None if it switches the check off.
        event: Called with every result.
        waived: Whether a load that is not the declared one is recorded and nothing more.
    """

    def __init__(
        self,
        plan: Plan,
        gravity: Sequence[float],
        robot: Capabilities,
        tolerance: Weigh | None,
        *,
        event: RecordEvent,
        waived: bool = False,
    ) -> None:
        self._plan = plan
        self._tolerance = tolerance or Weigh()
        self._event = event
        self._waived = waived
        self._gains = gains_of(robot)
        self._readings: dict[int, Reading | str] = {}
        self._before: LoadReading | str | None = None
        self._steps: dict[int, list[Step]] = {}
        for step in plan:
            if step.kind == "weigh":
                self._steps.setdefault(step.load, []).append(step)
        self._not_weighed = why_plan_not_weighed(plan, robot)
        if not self._not_weighed:
            # Now: while the arm moves there is no time for it.
            self._model = load_model(plan.robot_model, gravity=gravity)
        elif is_sweep(plan):
            self._event(CHECK, result="skipped", reason=self._not_weighed)

    def measured(self, step: Step, rows: StructArray) -> None:
        """Read a dwell's settled rows; after the last dwell of a load, judge the load.

        Raises:
            PreflightFailed: The load is not the declared one, or cannot be weighed; not if waived.
        """
        if self._not_weighed or step.kind != "weigh":
            return
        try:
            settle_rad_s = self._plan.dwell_rule(step).settle_rad_s
            self._readings[step.index] = reading_of(rows, self._gains, settle_rad_s)
        except DataError as error:
            self._readings[step.index] = error.message
        if step.index == self._steps[step.load][-1].index:
            self._judge(step.load)

    def restore(self, readings: Mapping[int, Reading | str]) -> None:
        """Take the first load's weighing from earlier attempts, for a run that is resumed.

        Other loads are compared with it, and so is the first load when it is weighed again.

        Args:
            readings: Of `readings_of_earlier_attempts`.
        """
        if self._not_weighed or not readings:
            return
        self._readings.update(readings)
        self._before = self._together(0)

    def _judge(self, load: int) -> None:
        first, this = self._together(0), self._together(load)
        if isinstance(first, str) or isinstance(this, str):
            problem = this if isinstance(this, str) else f"the first load is missing: {first}"
            self._refuse(load, f"load {load} could not be weighed: {problem}", {})
        elif load:
            self._compare(load, first, this)
        elif isinstance(self._before, LoadReading):
            self._compare(0, self._before, this)
        else:
            self._first(this)

    def _first(self, this: LoadReading) -> None:
        """Record the first load, which is not checked unless an earlier attempt has weighed it."""
        if self._before is None:
            self._event(CHECK, load=0, result="first", **friction_figures(this))
            return
        problem = f"load 0: its weighing in an earlier attempt cannot be read ({self._before})"
        problem += ", so nobody knows whether it is the load that was measured then"
        self._event(CHECK, load=0, result="inconclusive", problem=problem, **friction_figures(this))

    def _compare(self, load: int, first: LoadReading, this: LoadReading) -> None:
        """Judge what a load adds to the first one; the first load itself should add nothing."""
        loads = self._plan.loads[0].payload, self._plan.loads[load].payload
        comparison = compare_loads(self._model, self._steps[load], loads, (first, this))
        masses = [each.payload.mass for each in self._plan.loads]
        verdict = LoadVerdict(
            comparison, self._tolerance, difference_kg(masses, load), again=load == 0
        )
        figures = verdict.figures
        if not verdict.passed:
            problem = f"load {load}: {verdict.text(self._plan.joint_names)}"
            self._refuse(load, problem, figures)
        elif verdict.conclusive:
            self._event(CHECK, load=load, result="passed", **figures)
        else:
            problem = f"load {load}: {verdict.doubt}"
            self._event(CHECK, load=load, result="inconclusive", problem=problem, **figures)

    def _together(self, load: int) -> LoadReading | str:
        """Return the reading of a load from all of its dwells, or why there is none."""
        readings: dict[tuple[int, int], Reading] = {}
        for step in self._steps[load]:
            reading = self._readings.get(step.index, "nothing was recorded")
            if isinstance(reading, str):
                side = "below" if step.approach > 0 else "above"
                return f"at weighing pose {step.pose + 1} from {side}, {reading}"
            readings[step.pose, step.approach] = reading
        return combined_reading(readings)

    def _refuse(self, load: int, problem: str, figures: dict[str, Any]) -> None:
        result = "waived" if self._waived else "failed"
        self._event(CHECK, load=load, result=result, problem=problem, **figures)
        if not self._waived:
            compared = load == 0 and bool(figures)
            raise PreflightFailed(f"{CHECK}: {problem}", hint=AGAIN_HINT if compared else HINT)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The settled samples of one dwell: mean `torque` (n,) [N·m], `variance` (n,) of that mean."""

    torque: FloatArray
    variance: FloatArray


def gains_of(robot: Capabilities) -> FloatArray | float:
    """Return the factor from a robot's efforts to torques: (n,) drive gains [N·m/A], or 1."""
    return np.array(robot.drive_gains) if robot.effort_kind == "current" else 1.0


def reading_of(rows: StructArray, gains: FloatArray | float, settle_rad_s: float) -> Reading:
    """Return the reading of the settled rows of a dwell.

    Args:
        rows: State rows.
        gains: Of `gains_of`.
        settle_rad_s: Joint speed below which the arm is at rest [rad/s].

    Raises:
        DataError: The arm did not rest, or no effort was measured.
    """
    usable = rows[(rows["status"] & (Status.MASKED | Status.FAULT)) == 0]
    effort: FloatArray = usable["effort"] * gains
    if not len(usable) or not np.isfinite(effort).all():
        raise DataError(
            "the robot reported no usable effort",
            hint="see whether the drives are on and their effort is recorded",
        )
    if np.abs(usable["qd"]).max() >= settle_rad_s:
        raise DataError(
            "the arm did not come to rest",
            hint="see whether the arm is held, or its noise at rest too large to tell",
        )
    return Reading(effort.mean(axis=0), effort.var(axis=0) / len(usable))


@dataclass(frozen=True, slots=True, eq=False)
class LoadReading:
    """One load at all P poses, from both approaches.

    Attributes:
        torque: (P, n) mean of the two approaches [N·m].
        half_difference: (P, n) half the difference of the two approaches: friction [N·m].
        variance: (n,) variance of `torque`, from remaining friction and noise [N²·m²].
    """

    torque: FloatArray
    half_difference: FloatArray
    variance: FloatArray


FRICTION_LEFT = 0.05
"""Share of half the difference between the two approaches by which their mean errs (standard
deviation); measured on the mock, see docs/explanation/weighing.md."""


def combined_reading(readings: Mapping[tuple[int, int], Reading]) -> LoadReading:
    """Return the reading of one load, from its readings by pose and approach (±1)."""
    poses = sorted({pose for pose, _ in readings})
    below, above = ([readings[pose, sign] for pose in poses] for sign in (1, -1))
    up, down = (np.array([one.torque for one in side]) for side in (below, above))
    noise = np.mean([one.variance for one in (*below, *above)], axis=0) / 2
    half: FloatArray = (up - down) / 2
    friction = np.mean((FRICTION_LEFT * half) ** 2, axis=0)
    return LoadReading((up + down) / 2, half, friction + noise)


CHANGE_LEFT = 0.5
"""Share of the change of the half difference since the first load that adds to the error of the
mean: friction may have changed on one side alone, as the arm has become warmer."""

LEAST_NM = 0.01
"""Least standard deviation of a torque [N·m]: a simulation without noise has none."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadComparison:
    """A load as weighed, beside what was declared.

    Attributes:
        declared: The declared load.
        first_kg: Declared mass of the first load, which it is weighed against.
        weighed_kg: Its mass, if its centre of mass is the declared one.
        deviation_kg: Standard deviation of `weighed_kg`.
        free_kg: Its mass, wherever its centre of mass is.
        free_deviation_kg: Standard deviation of `free_kg`.
        shift_m: (3,) its centre of mass minus the declared one, flange frame; NaN without a load.
        shift_deviation_m: Standard deviation along `shift_m`.
        declared_nm, found_nm: (P, n) torque beyond that of the first load, declared and weighed.
    """

    declared: Payload
    first_kg: float
    weighed_kg: float
    deviation_kg: float
    free_kg: float
    free_deviation_kg: float
    shift_m: FloatArray
    shift_deviation_m: float
    declared_nm: FloatArray
    found_nm: FloatArray

    @property
    def distance_m(self) -> float:
        """Length of `shift_m`; 0 without a load, which has no centre of mass."""
        return 0.0 if self.declared.is_empty else float(np.linalg.norm(self.shift_m))


def compare_loads(
    model: RobotModel,
    steps: Sequence[Step],
    loads: tuple[Payload, Payload],
    readings: tuple[LoadReading, LoadReading],
) -> LoadComparison:
    """Weigh a load against the first one.

    Args:
        model: The arm, mounted as it is.
        steps: The weighing dwells of either load, in order.
        loads: The first load and the one to be weighed, as declared.
        readings: Of these.
    """
    first, load = loads
    at = {step.pose: step.motion.q_end for step in steps if step.motion is not None}
    columns = static_columns(model, np.array([at[pose] for pose in sorted(at)]))
    declared = columns @ (static_parameters(load) - static_parameters(first))
    weighed: FloatArray = readings[1].torque - readings[0].torque
    deviation = _deviation(*readings)
    # Errors of the gains are a share of the torque: the larger one, in case it is another load.
    torque = np.where(np.abs(weighed) > np.abs(declared), weighed, declared)
    excess: Weighed = Balance(columns, torque, deviation, load.com).weigh(weighed - declared)
    per_kg = np.nan if load.is_empty else 1 / load.mass
    return LoadComparison(
        declared=load,
        first_kg=first.mass,
        weighed_kg=load.mass + excess.mass,
        deviation_kg=excess.mass_deviation,
        free_kg=load.mass + excess.free_mass,
        free_deviation_kg=excess.free_mass_deviation,
        shift_m=excess.moment * per_kg,
        shift_deviation_m=excess.moment_deviation * per_kg,
        declared_nm=declared,
        found_nm=weighed,
    )


def _deviation(first: LoadReading, this: LoadReading) -> FloatArray:
    """Return the (P, n) standard deviation of the difference of two loads' torques [N·m].

    Errors of the drive gains are not in it.
    """
    change = CHANGE_LEFT * (this.half_difference - first.half_difference)
    variance = first.variance + this.variance + change**2
    return np.asarray(np.sqrt(np.maximum(variance, LEAST_NM**2)))


SURE = 4.0
"""Number of standard deviations up to which a difference may be the weighing's own error."""

TELLING = 0.5
"""A limit below this share of the difference between two loads tells them apart."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadVerdict:
    """The verdict on a load: a comparison and its limits.

    A weighing that is less certain than the tolerances (a short reach, high friction) is judged by
    its own certainty. If no centre of mass is declared, or the load has another one, the mass that
    counts is `free_kg`, which does not depend on it.

    Attributes:
        comparison: The load as weighed.
        tolerance: Of the spec.
        differs_kg: Difference to the load that may be mounted instead, see `difference_kg`.
        again: Whether it is the first load, compared with its weighing in an earlier attempt.
    """

    comparison: LoadComparison
    tolerance: Weigh
    differs_kg: float
    again: bool = False

    @property
    def weighed_kg(self) -> float:
        """The mass that counts."""
        return self.comparison.weighed_kg if self._centre_known else self.comparison.free_kg

    @property
    def deviation_kg(self) -> float:
        """Standard deviation of `weighed_kg`."""
        load = self.comparison
        return load.deviation_kg if self._centre_known else load.free_deviation_kg

    @property
    def mass_limit_kg(self) -> float:
        """Largest difference of the mass from the declared one that passes."""
        tolerance, load = self.tolerance, self.comparison
        difference = abs(load.declared.mass - load.first_kg)
        tolerated = tolerance.tolerance_kg + tolerance.tolerance_percent / 100 * difference
        return max(tolerated, SURE * self.deviation_kg)

    @property
    def com_limit_m(self) -> float:
        """Largest distance of the centre of mass from the declared one that passes."""
        sure = SURE * self.comparison.shift_deviation_m
        return max(self.tolerance.tolerance_com_m, sure if np.isfinite(sure) else 0.0)

    @property
    def mass_passed(self) -> bool:
        """Whether the mass is near enough to the declared one."""
        return abs(self.weighed_kg - self.comparison.declared.mass) <= self.mass_limit_kg

    @property
    def com_passed(self) -> bool:
        """Whether the centre of mass is near enough to the declared one."""
        return self.comparison.distance_m <= self.com_limit_m

    @property
    def passed(self) -> bool:
        """Whether the load is the one declared."""
        return self.mass_passed and self.com_passed

    @property
    def conclusive(self) -> bool:
        """Whether the mass of another load would not have passed as well."""
        return self.mass_limit_kg < TELLING * self.differs_kg

    @property
    def figures(self) -> dict[str, Any]:
        """Plain numbers for the event log."""
        load = self.comparison
        figures: dict[str, Any] = {
            "declared_kg": load.declared.mass,
            "weighed_kg": _plain(self.weighed_kg),
            "deviation_kg": _plain(self.deviation_kg),
            "limit_kg": _plain(self.mass_limit_kg),
            "differs_kg": _plain(self.differs_kg),
            "declared_nm": _plain(load.declared_nm),
            "found_nm": _plain(load.found_nm),
        }
        if not load.declared.is_empty:
            figures |= {
                "com_m": list(load.declared.com),
                "shift_m": _plain(load.shift_m),
                "shift_deviation_m": _plain(load.shift_deviation_m),
                "shift_limit_m": _plain(self.com_limit_m),
            }
        return figures

    def text(self, joint_names: Sequence[str]) -> str:
        """Return what is wrong, with the torques joint by joint."""
        headline = self._masses
        if not self.com_passed:
            headline += f"; {self._centre()}"
        return "\n".join([headline, *_by_joint(self.comparison, joint_names)])

    @property
    def doubt(self) -> str:
        """Why a load that passed may not be the declared one all the same."""
        apart = f"{self.differs_kg:.2f} kg"
        return f"{self._masses}, which does not tell loads apart that differ by {apart}"

    @property
    def _masses(self) -> str:
        load = self.comparison
        earlier = " in an earlier attempt" if self.again else ""
        return (
            f"{load.declared.mass:.2f} kg declared, {self.weighed_kg:.2f} ± "
            f"{self.deviation_kg:.2f} kg weighed against the {load.first_kg:.2f} kg of load 0"
            f"{earlier} (limit ± {self.mass_limit_kg:.2f} kg)"
        )

    @property
    def _centre_known(self) -> bool:
        return self.com_passed and not self.comparison.declared.is_empty

    def _centre(self) -> str:
        load = self.comparison
        seen = np.array(load.declared.com) + load.shift_m
        return (
            f"centre of mass at {_point(load.declared.com)} m declared, near {_point(seen)} m "
            f"weighed: {1e3 * load.distance_m:.0f} ± {1e3 * load.shift_deviation_m:.0f} mm away "
            f"(limit {1e3 * self.com_limit_m:.0f} mm)"
        )


def _plain(value: FloatArray | float) -> Any:
    """Return a value for JSON, to a tenth of a gram and of a millinewton metre; None if unknown."""
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value]
    return round(float(value), 4) if np.isfinite(value) else None


def _by_joint(load: LoadComparison, joint_names: Sequence[str]) -> list[str]:
    declared, weighed = (
        [", ".join(f"{round(value, 1) + 0.0:.1f}" for value in column) for column in torque.T]
        for torque in (load.declared_nm, load.found_nm)
    )
    lines = [
        f"  {name}: {a} declared, {b} weighed;"
        for name, a, b in zip(joint_names, declared, weighed, strict=True)
    ]
    return ["  torque it adds, pose by pose [N·m]:", *lines[:-1], lines[-1].rstrip(";")]


def _point(at: Sequence[float] | FloatArray) -> str:
    return f"({', '.join(f'{x:.3f}' for x in at)})"


def difference_kg(masses: Sequence[float], load: int) -> float:
    """Return by how much a load differs from the first one, which may still be mounted [kg].

    Of a load that weighs the same as the first: from the nearest other mass; 0 if there is none.
    """
    own = masses[load]
    others = [abs(own - other) for other in masses if other != own]
    return abs(own - masses[0]) or min(others, default=0.0)


def friction_figures(first: LoadReading) -> dict[str, Any]:
    """Return the figures of the first load for the event log: friction, pose by pose."""
    return {"half_difference_nm": _plain(first.half_difference)}


Readings = dict[int, Reading | str]
"""Index of a weighing dwell → its reading, or why there is none."""


def readings_of_earlier_attempts(
    plan: Plan, recordings: Iterable[Path], robot: Capabilities
) -> Readings:
    """Return the readings of the first load in the newest attempt whose weighing counts.

    Args:
        plan: Of the whole run.
        recordings: `RunDirectory.recordings`.
        robot: With the kind of its efforts and its drive gains.

    Returns:
        Nothing if no attempt went on to measure, or if nothing is weighed in this run. Reasons
        instead of readings only if none of the attempts that went on can be read.

    Raises:
        DataError: A recording is no MCAP file at all, or of a newer hil.
    """
    steps = {step.index: step for step in plan if step.kind == "weigh" and step.load == 0}
    if why_plan_not_weighed(plan, robot):
        return {}
    past = {step.index for step in plan if step.measures or step.load}
    newest: Readings = {}
    for rows, seen in recorded_steps(recordings, steps):
        # An attempt under later loads alone had no need to weigh the first one.
        if seen.isdisjoint(past) or (newest and not rows):
            continue
        own = {index: _reading_of_step(plan, steps[index], rows, robot) for index in steps}
        if all_reliable(own) or not all_reliable(newest):
            newest = own
    return newest


def _reading_of_step(
    plan: Plan, step: Step, recorded: Mapping[int, StructArray], robot: Capabilities
) -> Reading | str:
    rows = recorded.get(step.index)
    if rows is None:
        return "nothing was recorded"
    if not step_is_complete(step, rows, plan):
        return "the recording is torn"
    rule = plan.dwell_rule(step)
    try:
        return reading_of(rows[-rule.samples :], gains_of(robot), rule.settle_rad_s)
    except DataError as error:
        return error.message


def all_reliable(readings: Mapping[int, Reading | str]) -> bool:
    """Return whether there are readings, and no reasons in place of one."""
    return bool(readings) and not any(isinstance(one, str) for one in readings.values())
