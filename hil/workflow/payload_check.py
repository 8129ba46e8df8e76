"""Payload check: compare the mounted load with the declared load before any measurement.

The engine passes the settled rows of every dwell to the payload check (`Engine(...,
measured=check.measured)`). The arm dwells at each payload-check pose twice, with an approach from
below and one from above: the mean of the two torques is the static torque, half their difference is
the friction (`combined_reading`). The check subtracts the torques of the first load at the same
poses and compares the difference with the difference that the declared loads predict, so that
friction and model errors of the arm cancel (`compare_loads`). The first load itself is not checked,
because the first load is the reference for the other loads. A `LoadVerdict` contains the result of
the payload check for operators and for the event log. A load that differs from the declared load
stops the run, unless the check is waived.

A resumed run reads the readings of its first load from the recordings of earlier attempts
(`readings_of_earlier_attempts`). The readings of an earlier attempt are used only if that attempt
continued to measurements: a refused or cancelled payload check does not show which load was mounted
during the measurements.
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
"""Name of the payload check in preflight checks and waivers, and kind of its events."""

HINT = (
    "mount the declared load in the declared orientation; or correct `loads` in the spec; "
    f'or waive the check: --waive "{CHECK}=REASON"'
)

AGAIN_HINT = (
    "mount load 0 as in the earlier attempt, and resume again; if a different load was mounted "
    f'then, run the experiment again; or waive the check: --waive "{CHECK}=REASON"'
)
"""Hint of the error for a first load that differs from the first load of an earlier attempt."""


class RecordEvent(Protocol):
    """Function that records results, such as the `event` method of a sink."""

    def __call__(self, kind: str, **details: Any) -> object:
        """Record an event."""


class PayloadCheck:
    """Payload check of all loads of one run; if the check is skipped, an event records this.

    Args:
        plan: Plan of the whole run.
        gravity: (3,) gravity vector in the base frame [m/s²].
        robot: Capabilities of the robot, with the kind of effort and the drive gains.
        tolerance: Tolerances of the spec; None if the spec switches the payload check off.
        event: Function that is called with every result of a check.
        waived: Whether a load that differs from the declared load is only recorded.
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
            # Loaded in advance, because loading takes too long while the arm moves.
            self._model = load_model(plan.robot_model, gravity=gravity)
        elif is_sweep(plan):
            self._event(CHECK, result="skipped", reason=self._not_weighed)

    def measured(self, step: Step, rows: StructArray) -> None:
        """Store the settled rows of a dwell; after the last dwell of a load, check the load.

        Raises:
            PreflightFailed: The load differs from the declared load, or cannot be identified; not
                raised if the check is waived.
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
        """Restore the readings of the first load from earlier attempts of a resumed run.

        The later loads are compared with the restored readings. If the first load is measured
        again, the new readings are compared with the restored ones.

        Args:
            readings: Readings of the first load, returned by `readings_of_earlier_attempts`.
        """
        if self._not_weighed or not readings:
            return
        self._readings.update(readings)
        self._before = self._together(0)

    def _judge(self, load: int) -> None:
        first, this = self._together(0), self._together(load)
        if isinstance(first, str) or isinstance(this, str):
            missing = f"readings of the first load are missing: {first}"
            problem = this if isinstance(this, str) else missing
            self._refuse(load, f"load {load} could not be weighed: {problem}", {})
        elif load:
            self._compare(load, first, this)
        elif isinstance(self._before, LoadReading):
            self._compare(0, self._before, this)
        else:
            self._first(this)

    def _first(self, this: LoadReading) -> None:
        """Record the first load; its readings are not compared with other readings."""
        if self._before is None:
            self._event(CHECK, load=0, result="first", **friction_figures(this))
            return
        problem = f"load 0: the weighing of an earlier attempt cannot be read ({self._before})"
        problem += ", so it is unknown whether the same load is mounted now"
        self._event(CHECK, load=0, result="inconclusive", problem=problem, **friction_figures(this))

    def _compare(self, load: int, first: LoadReading, this: LoadReading) -> None:
        """Check the torque difference between a load and the first load.

        For the first load, the reference is the reading of the same load in an earlier attempt, so
        the expected difference is zero.
        """
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
        """Return the combined reading of all dwells of a load, or the reason why it is missing."""
        readings: dict[tuple[int, int], Reading] = {}
        for step in self._steps[load]:
            reading = self._readings.get(step.index, "nothing was recorded")
            if isinstance(reading, str):
                side = "below" if step.approach > 0 else "above"
                return f"at payload-check pose {step.pose + 1} from {side}, {reading}"
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
    """Mean torques of the settled samples of one dwell of an arm with n joints.

    `torque` (n,) is the mean torque [N·m], and `variance` (n,) is the variance of the mean torque
    [N²·m²].
    """

    torque: FloatArray
    variance: FloatArray


def gains_of(robot: Capabilities) -> FloatArray | float:
    """Return the factor from efforts of a robot to torques: (n,) drive gains [N·m/A], or 1."""
    return np.array(robot.drive_gains) if robot.effort_kind == "current" else 1.0


def reading_of(rows: StructArray, gains: FloatArray | float, settle_rad_s: float) -> Reading:
    """Return the mean torques and their variances for the settled rows of a dwell.

    Args:
        rows: State rows.
        gains: Factor from efforts to torques, returned by `gains_of`.
        settle_rad_s: Joint speed below which the arm counts as static [rad/s].

    Raises:
        DataError: The arm was not static, or the rows contain no measured effort.
    """
    usable = rows[(rows["status"] & (Status.MASKED | Status.FAULT)) == 0]
    effort: FloatArray = usable["effort"] * gains
    if not len(usable) or not np.isfinite(effort).all():
        raise DataError(
            "the robot reported no usable effort",
            hint="check that the drives are on and that their effort is recorded",
        )
    if np.abs(usable["qd"]).max() >= settle_rad_s:
        raise DataError(
            f"the arm did not come to rest (below {settle_rad_s:g} rad/s)",
            hint="check that the drives hold the arm, and how large the velocity noise at "
            "standstill is",
        )
    return Reading(effort.mean(axis=0), effort.var(axis=0) / len(usable))


@dataclass(frozen=True, slots=True, eq=False)
class LoadReading:
    """Torques of one load at all P payload-check poses, from both approaches.

    Attributes:
        torque: (P, n) mean torque of the two approaches [N·m].
        half_difference: (P, n) half the difference of the two approaches: friction [N·m].
        variance: (n,) variance of `torque`, from remaining friction and noise [N²·m²].
    """

    torque: FloatArray
    half_difference: FloatArray
    variance: FloatArray


FRICTION_LEFT = 0.05
"""Standard deviation of the mean torque of both approaches, as a share of half the torque
difference.

The share was measured on the mock, see docs/explanation/weighing.md.
"""


def combined_reading(readings: Mapping[tuple[int, int], Reading]) -> LoadReading:
    """Return the reading of one load from the readings of its dwells by pose and approach (±1)."""
    poses = sorted({pose for pose, _ in readings})
    below, above = ([readings[pose, sign] for pose in poses] for sign in (1, -1))
    up, down = (np.array([one.torque for one in side]) for side in (below, above))
    noise = np.mean([one.variance for one in (*below, *above)], axis=0) / 2
    half: FloatArray = (up - down) / 2
    friction = np.mean((FRICTION_LEFT * half) ** 2, axis=0)
    return LoadReading((up + down) / 2, half, friction + noise)


CHANGE_LEFT = 0.5
"""Share of the change of the half difference that is added to the standard deviation of the
mean.

The change of the half difference is counted from the check of the first load onwards. Friction
possibly changes in only one direction of motion as the arm becomes warmer, which shifts the mean
torque.
"""

LEAST_NM = 0.01
"""Minimum standard deviation of a torque [N·m], needed for simulations without noise."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadComparison:
    """Identified load in comparison with the declared load.

    Attributes:
        declared: Declared load.
        first_kg: Declared mass of the first load, which is the reference [kg].
        weighed_kg: Identified mass, on the assumption that the declared centre of mass is correct
            [kg].
        deviation_kg: Standard deviation of `weighed_kg` [kg].
        free_kg: Identified mass, without an assumption about the centre of mass [kg].
        free_deviation_kg: Standard deviation of `free_kg` [kg].
        shift_m: (3,) identified minus declared centre of mass, in the flange frame [m]; NaN without
            a load.
        shift_deviation_m: Standard deviation of the centre of mass in the direction of `shift_m`
            [m].
        declared_nm, found_nm: (P, n) torque difference to the first load, declared and measured
            [N·m].
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
        """Length of `shift_m` [m]; 0 for an empty flange, which has no centre of mass."""
        return 0.0 if self.declared.is_empty else float(np.linalg.norm(self.shift_m))


def compare_loads(
    model: RobotModel,
    steps: Sequence[Step],
    loads: tuple[Payload, Payload],
    readings: tuple[LoadReading, LoadReading],
) -> LoadComparison:
    """Identify a load relative to the first load and compare the load with its declaration.

    Args:
        model: Model of the arm, with gravity in its mounting orientation.
        steps: Payload-check dwells of one load, in order; the poses are the same for every load.
        loads: Pair of the declared first load and the declared load to check.
        readings: Readings of the two loads, in the order of `loads`.
    """
    first, load = loads
    at = {step.pose: step.motion.q_end for step in steps if step.motion is not None}
    columns = static_columns(model, np.array([at[pose] for pose in sorted(at)]))
    declared = columns @ (static_parameters(load) - static_parameters(first))
    weighed: FloatArray = readings[1].torque - readings[0].torque
    deviation = _deviation(*readings)
    # Gain errors are proportional to the torque: use the larger one, in case of a different load.
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
    """Return the (P, n) standard deviation of the torque difference of two loads [N·m].

    Errors of the drive gains are not included in the standard deviation.
    """
    change = CHANGE_LEFT * (this.half_difference - first.half_difference)
    variance = first.variance + this.variance + change**2
    return np.asarray(np.sqrt(np.maximum(variance, LEAST_NM**2)))


SURE = 4.0
"""Number of standard deviations up to which a difference is attributed to the measurement error."""

TELLING = 0.5
"""Maximum ratio of mass limit to mass difference with which a check distinguishes two loads."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadVerdict:
    """Verdict on a load: comparison with the declared load, and limits for the differences.

    If the uncertainty of the identified mass exceeds the tolerances (for a short reach or high
    friction), the limit is computed from the uncertainty. If no centre of mass is declared, or if
    the load has a different centre of mass, the verdict uses `free_kg`, which does not depend on
    the centre of mass.

    Attributes:
        comparison: Comparison of the identified with the declared load.
        tolerance: Tolerances for mass and centre of mass from the spec.
        differs_kg: Mass difference to the load that may be mounted by mistake [kg], see
            `difference_kg`.
        again: Whether the load is the first load, which is compared with its reading in an earlier
            attempt.
    """

    comparison: LoadComparison
    tolerance: Weigh
    differs_kg: float
    again: bool = False

    @property
    def weighed_kg(self) -> float:
        """Identified mass that the verdict uses [kg]."""
        return self.comparison.weighed_kg if self._centre_known else self.comparison.free_kg

    @property
    def deviation_kg(self) -> float:
        """Standard deviation of `weighed_kg` [kg]."""
        load = self.comparison
        return load.deviation_kg if self._centre_known else load.free_deviation_kg

    @property
    def mass_limit_kg(self) -> float:
        """Largest accepted difference of identified and declared mass [kg]."""
        tolerance, load = self.tolerance, self.comparison
        difference = abs(load.declared.mass - load.first_kg)
        tolerated = tolerance.tolerance_kg + tolerance.tolerance_percent / 100 * difference
        return max(tolerated, SURE * self.deviation_kg)

    @property
    def com_limit_m(self) -> float:
        """Largest accepted distance of identified and declared centre of mass [m]."""
        sure = SURE * self.comparison.shift_deviation_m
        return max(self.tolerance.tolerance_com_m, sure if np.isfinite(sure) else 0.0)

    @property
    def mass_passed(self) -> bool:
        """Whether the difference of identified and declared mass is within the limit."""
        return abs(self.weighed_kg - self.comparison.declared.mass) <= self.mass_limit_kg

    @property
    def com_passed(self) -> bool:
        """Whether the distance of identified and declared centre of mass is within the limit."""
        return self.comparison.distance_m <= self.com_limit_m

    @property
    def passed(self) -> bool:
        """Whether mass and centre of mass are within their limits."""
        return self.mass_passed and self.com_passed

    @property
    def conclusive(self) -> bool:
        """Whether the check would have rejected the mass of a different load of the run."""
        return self.mass_limit_kg < TELLING * self.differs_kg

    @property
    def figures(self) -> dict[str, Any]:
        """Result of the check as plain numbers, for the event log."""
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
        """Return a description of the mismatch of the load, with the torques of each joint."""
        headline = self._masses
        if not self.com_passed:
            headline += f"; {self._centre()}"
        return "\n".join([headline, *_by_joint(self.comparison, joint_names)])

    @property
    def doubt(self) -> str:
        """Reason why a load that passed is possibly not the declared load."""
        apart = f"{self.differs_kg:.2f} kg"
        return f"{self._masses}; the check cannot distinguish loads that differ by {apart}"

    @property
    def _masses(self) -> str:
        load = self.comparison
        earlier = " in an earlier attempt" if self.again else ""
        return (
            f"{load.declared.mass:.2f} kg declared, {self.weighed_kg:.2f} ± "
            f"{self.deviation_kg:.2f} kg measured relative to the {load.first_kg:.2f} kg of load 0"
            f"{earlier} (limit ± {self.mass_limit_kg:.2f} kg)"
        )

    @property
    def _centre_known(self) -> bool:
        return self.com_passed and not self.comparison.declared.is_empty

    def _centre(self) -> str:
        load = self.comparison
        seen = np.array(load.declared.com) + load.shift_m
        return (
            f"centre of mass declared at {_point(load.declared.com)} m, measured near "
            f"{_point(seen)} m: {1e3 * load.distance_m:.0f} ± "
            f"{1e3 * load.shift_deviation_m:.0f} mm away (limit {1e3 * self.com_limit_m:.0f} mm)"
        )


def _plain(value: FloatArray | float) -> Any:
    """Return a value for JSON, rounded to four decimals (0.1 g, 0.1 mN·m); None if not finite."""
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value]
    return round(float(value), 4) if np.isfinite(value) else None


def _by_joint(load: LoadComparison, joint_names: Sequence[str]) -> list[str]:
    declared, weighed = (
        [", ".join(f"{round(value, 1) + 0.0:.1f}" for value in column) for column in torque.T]
        for torque in (load.declared_nm, load.found_nm)
    )
    lines = [
        f"  {name}: {a} declared, {b} measured;"
        for name, a, b in zip(joint_names, declared, weighed, strict=True)
    ]
    heading = "  additional torque of the load, pose by pose [N·m]:"
    return [heading, *lines[:-1], lines[-1].rstrip(";")]


def _point(at: Sequence[float] | FloatArray) -> str:
    return f"({', '.join(f'{x:.3f}' for x in at)})"


def difference_kg(masses: Sequence[float], load: int) -> float:
    """Return the mass difference between a load and the first one, which may still be mounted [kg].

    If the load has the same mass as the first load, return the difference to the nearest different
    mass of the run; 0 if all masses are equal.
    """
    own = masses[load]
    others = [abs(own - other) for other in masses if other != own]
    return abs(own - masses[0]) or min(others, default=0.0)


def friction_figures(first: LoadReading) -> dict[str, Any]:
    """Return the friction torques of the first load, by pose [N·m], for the event log."""
    return {"half_difference_nm": _plain(first.half_difference)}


Readings = dict[int, Reading | str]
"""Reading of each payload-check dwell, or the reason why the reading is missing, by step index."""


def readings_of_earlier_attempts(
    plan: Plan, recordings: Iterable[Path], robot: Capabilities
) -> Readings:
    """Return the readings of the first load from the newest attempt that continued to measurements.

    Args:
        plan: Plan of the whole run, with the payload-check steps.
        recordings: Recordings of the run, see `RunDirectory.recordings`.
        robot: Capabilities of the robot, with the kind of effort and the drive gains.

    Returns:
        Readings of the payload-check dwells, by step index. The mapping is empty if no attempt
        continued to measurements, or if the run has no payload check. The mapping contains reasons
        instead of readings only if none of these attempts is readable.

    Raises:
        DataError: A recording is not an MCAP file, or was written by a newer version of hil.
    """
    steps = {step.index: step for step in plan if step.kind == "weigh" and step.load == 0}
    if why_plan_not_weighed(plan, robot):
        return {}
    past = {step.index for step in plan if step.measures or step.load}
    newest: Readings = {}
    for rows, seen in recorded_steps(recordings, steps):
        # An attempt with only later loads did not check the first load.
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
        return "the recording is incomplete"
    rule = plan.dwell_rule(step)
    try:
        return reading_of(rows[-rule.samples :], gains_of(robot), rule.settle_rad_s)
    except DataError as error:
        return error.message


def all_reliable(readings: Mapping[int, Reading | str]) -> bool:
    """Return whether there are readings and every entry is a reading instead of a reason."""
    return bool(readings) and not any(isinstance(one, str) for one in readings.values())
