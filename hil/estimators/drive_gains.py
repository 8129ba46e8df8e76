"""Drive gains (torque per motor current of each joint): identification, storage and use.

A fit in torques needs drive gains, and data sheets rarely contain them. Two methods identify drive
gains: `calibrate_gains` uses payloads of known mass (`Gains`), and `controller_gains` uses the
torques and currents that a controller commands (`ControllerGains`). Each of the two methods
provides the YAML lines for a station or an import map. `write_gains` and `read_gains` store drive
gains in a file (`hil drive-gains -o`, `hil fit --gains`), and `DriveGains.of` adds them to a
recording. The drive gain is the slope of the drive curve at zero current; see
`hil.estimators.drive_curve`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from hil.arms import Payload
from hil.core import (
    BoolArray,
    DataError,
    FitError,
    FloatArray,
    IntArray,
    RecordingError,
    SpecError,
    read_source,
)
from hil.data import Dataset, dwells_of, series_means
from hil.dynamics import RobotModel, friction_terms
from hil.estimators.checks import require_clean, require_plausible, require_robot
from hil.estimators.covariance import ClusterSums, clustered_covariance, time_blocks
from hil.estimators.least_squares import instrumental, weighted_least_squares

KEY, SOURCE_KEY = "drive_gains_nm_a", "drive_gains_source"


@dataclass(frozen=True, slots=True, eq=False)
class DriveGains:
    """Drive gains: torque per motor current of every joint.

    Attributes:
        values: (n,) drive gains [N·m/A], above 0.
        source: Text that states the source of the drive gains.
    """

    values: FloatArray
    source: str

    def of(self, dataset: Dataset) -> Dataset:
        """Return the recording with these drive gains instead of its declared gains.

        Raises:
            DataError: The number of gains differs from the number of joints, or the recording
                contains torques.
        """
        if dataset.effort_kind != "current":
            raise DataError(
                "drive gains turn currents into torques, but the recording contains torques",
                hint="leave out the gains",
            )
        if len(self.values) != dataset.n_joints:
            raise DataError(
                f"expected {dataset.n_joints} drive gains, one per joint, got {len(self.values)}",
                hint="list one gain per joint, from base to flange",
            )
        return replace(dataset, drive_gains=self.values, drive_gains_source=self.source)


def read_gains(path: Path) -> DriveGains:
    """Return the drive gains of a YAML file, such as an import map.

    The command `hil drive-gains -o` writes such a file.

    Raises:
        SpecError: The file cannot be read, or has no `drive_gains_nm_a` of positive numbers.
    """
    content = read_source(path).data
    document = content if isinstance(content, dict) else {}
    listed_gains = document.get(KEY)
    numbers = listed_gains if isinstance(listed_gains, list) else []
    if not numbers or not all(_is_gain(number) for number in numbers):
        raise SpecError(
            f"{path}: {KEY} is missing, or is not a list of numbers above 0, one per joint",
            hint="write such a file with: hil drive-gains SOURCE -o gains.yaml",
        )
    source = str(document.get(SOURCE_KEY) or path.name)
    return DriveGains(np.array(numbers, dtype=np.float64), source)


def _is_gain(number: object) -> bool:
    if isinstance(number, bool) or not isinstance(number, int | float):
        return False
    return bool(np.isfinite(number)) and number > 0


def write_gains(path: Path, lines: Sequence[str]) -> None:
    """Write the lines of `Gains.yaml_lines` to a new YAML file.

    Raises:
        DataError: There are no YAML lines, because the gain of a joint is unknown.
        RecordingError: The file for the drive gains already exists.
    """
    if not lines:
        raise DataError(
            "the drive gains of some joints are unknown, so no file was written",
            hint="declare drive_gains_nm_a in the import map: joints without a result keep the "
            "declared gain",
        )
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("\n".join(lines) + "\n")
    except FileExistsError:
        raise RecordingError(
            f"{path} already exists", hint="choose a different file for -o"
        ) from None


KEPT = "as declared before"
"""Text in the source of drive gains that marks joints whose gain was not determined."""

CALIBRATED = ("calibrated with ", "the controller's current per torque ")
"""Beginnings of the source texts that `hil drive-gains` writes."""


def calibrated(source: str) -> bool:
    """Return whether a source text states that all gains were measured on the arm itself."""
    return source.startswith(CALIBRATED) and KEPT not in source


def gain_lines(
    names: tuple[str, ...],
    gain: FloatArray,
    reasons: tuple[str, ...],
    declared: FloatArray | None,
    source: str,
) -> list[str]:
    """Return the YAML lines with drive gains and source, for a station or an import map.

    Args:
        names: Names of the n joints.
        gain: (n,) measured gains [N·m/A].
        reasons: Reason why the gain of each joint is not determined; empty for a determined gain.
        declared: (n,) declared gains, used for joints whose gain is not determined. If `declared`
            is None, no lines are returned unless all gains are determined, because a map needs a
            gain for every joint.
        source: Text that states the source of the gains.
    """
    other = [name for name, reason in zip(names, reasons, strict=True) if reason]
    if declared is None and other:
        return []
    kept = gain if declared is None else declared
    values = np.where([not reason for reason in reasons], gain, kept)
    source += f"; {', '.join(other)} {KEPT}" if other else ""
    text = ", ".join(f"{value:.3f}" for value in values)
    return [f"drive_gains_nm_a: [{text}]", f'drive_gains_source: "{source}"']


def listed(values: FloatArray) -> list[float | None]:
    """Return the numbers as JSON values; None replaces numbers that are not finite."""
    return [float(value) if np.isfinite(value) else None for value in values]


LEAST_POSES = 5

LEAST_TORQUE = 0.01
"""Torque [N·m] below which a payload counts as having no effect on a joint; due to rounding."""

NO_TORQUE = (
    "the payloads cause no torque about the axis of this joint, which is vertical or passes "
    "through their centres of mass"
)

MOST_ERROR = 0.05
"""Maximum relative standard error of a gain that counts as determined.

A gain with this maximum relative error differs from 0 by twenty standard errors.
"""

NOT_POSITIVE = (
    "the current falls when the payload torque rises: current or joint have the opposite sign to "
    "the robot model, or a declared mass or centre of mass is wrong"
)

MOST_BEND_ERROR = 0.03
"""Maximum standard error of K₂·i at the largest current, as a share of the gain.

If the standard error of K₂·i is larger, K₂ is not reported, because real drive curves deviate from
a line by only a few percent.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Drive gain of every joint, identified from known payloads; NaN if not determined.

    Attributes:
        joint_names: Names of the n joints.
        gain: (n,) additional torque of the payloads per additional current [N·m/A]; this gain is
            for models with a linear drive.
        gain_error: (n,) standard error of `gain`, clustered by pose, for exactly known payloads.
        k1, k1_error: (n,) constant K₁ of eq. 16, which is the gain at zero current, and its
            standard error [N·m/A].
        k2, k2_error: (n,) constant K₂ of eq. 16 and its standard error [N·m/A²].
        reasons: Reason why the gain of each joint is not determined; empty for a determined gain.
        masses: List of the payload masses [kg].
        poses: Number of poses that were compared.
        both_sides: Whether each pose was approached from both directions.
        declared: (n,) gains that the recording declares; None without declared gains.
        notes: List of notes for the user.
    """

    method: ClassVar[str] = "known-loads"

    joint_names: tuple[str, ...]
    gain: FloatArray
    gain_error: FloatArray
    k1: FloatArray
    k1_error: FloatArray
    k2: FloatArray
    k2_error: FloatArray
    reasons: tuple[str, ...]
    masses: tuple[float, ...]
    poses: int
    both_sides: bool
    declared: FloatArray | None
    notes: tuple[str, ...] = ()

    @property
    def determined(self) -> BoolArray:
        """Mask (n,) of the joints whose gain is determined."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def to_dict(self) -> dict[str, Any]:
        """Return the result for `hil drive-gains --json`; undetermined values are None."""
        return {
            "method": self.method,
            "joint_names": list(self.joint_names),
            "gain_nm_a": listed(self.gain),
            "gain_error_nm_a": listed(self.gain_error),
            "k1_nm_a": listed(self.k1),
            "k1_error_nm_a": listed(self.k1_error),
            "k2_nm_a2": listed(self.k2),
            "k2_error_nm_a2": listed(self.k2_error),
            "not_determined": {
                name: reason
                for name, reason in zip(self.joint_names, self.reasons, strict=True)
                if reason
            },
            "masses_kg": list(self.masses),
            "poses": self.poses,
            "both_sides": self.both_sides,
            "declared_nm_a": None if self.declared is None else listed(self.declared),
            "yaml": self.yaml_lines(),
            "notes": list(self.notes),
        }

    def yaml_lines(self) -> list[str]:
        """Return the YAML lines with drive gains and source, for a station or an import map.

        Joints whose gain is not determined keep the gain that the recording declares.
        """
        masses = ", ".join(f"{mass:g}" for mass in self.masses)
        source = f"calibrated with {masses} kg at {self.poses} poses"
        return gain_lines(self.joint_names, self.gain, self.reasons, self.declared, source)


def calibrate_gains(dataset: Dataset, robot: RobotModel) -> Gains:
    """Return drive gains from dwells at the same poses with at least two known payloads.

    The additional torque of a payload at each joint follows from its mass, its centre of mass and
    the joint positions. The additional current that a payload causes is measured. In the difference
    between payloads, everything else cancels: the gravity of the arm, offsets, and most of the
    static friction, which is nearly equal for the same pose and approach direction.

    Friction that grows with the transmitted torque does not cancel in the difference. If a pose is
    approached from below, friction holds a few percent of the payload; if the pose is approached
    from above, the current is larger by the same percentage. The mean of both approach directions
    does not contain the friction that grows with the torque. With only one approach direction, this
    friction remains in the gain, and a note reports the remaining error.

    The currents contain noise, whereas the torques are exact. A regression of torque on current
    would therefore give gains that are too small. To avoid this bias, the torques serve as
    instruments (two-stage least squares). The instruments of the differenced eq. 16, Δτ = K₁·Δi +
    K₂·Δ(i²·sign i), are Δτ and Δ(τ̂·abs(τ̂)), with τ̂ the static torque of the robot model.

    Args:
        dataset: Dwells with motor currents, recorded with known payloads. The declared payload of
            each series is assumed to be exact.
        robot: Robot model. The payload torques follow from the kinematics of the robot model. The
            masses of the robot model are used for the instruments, and to correct small differences
            between the positions of a pose.

    Raises:
        FitError: The efforts are torques, not finite, impossible, or of a different robot. Fewer
            than five poses were held with two payloads and the same approach direction.
    """
    if dataset.effort_kind != "current":
        raise FitError(
            f"drive gains are torque per current, the data contain a {dataset.effort_kind}",
            hint="record motor currents",
        )
    require_robot(dataset, robot)
    require_clean(dataset, ("t", "q", "effort"))
    require_plausible(dataset, robot)
    pairs = paired(dwells_of(dataset), robot)
    poses = len(set(pairs.pose.tolist()))
    if poses < LEAST_POSES:
        raise FitError(
            f"{poses} poses with two payloads and the same approach direction are too few: drive "
            f"gains need at least {LEAST_POSES}, better 40",
            hint="run experiments/ur5_gains.yaml, or the same dwell program with each payload",
        )
    joints = [_of_joint(pairs, j) for j in range(dataset.n_joints)]
    return Gains(
        joint_names=dataset.joint_names,
        gain=np.array([joint.gain for joint in joints]),
        gain_error=np.array([joint.gain_error for joint in joints]),
        k1=np.array([joint.k1 for joint in joints]),
        k1_error=np.array([joint.k1_error for joint in joints]),
        k2=np.array([joint.k2 for joint in joints]),
        k2_error=np.array([joint.k2_error for joint in joints]),
        reasons=tuple(joint.reason for joint in joints),
        masses=pairs.masses,
        poses=poses,
        both_sides=pairs.both_sides,
        declared=dataset.drive_gains,
        notes=pairs.notes,
    )


class _Joint(NamedTuple):
    gain: float = np.nan
    gain_error: float = np.nan
    k1: float = np.nan
    k1_error: float = np.nan
    k2: float = np.nan
    k2_error: float = np.nan
    reason: str = ""


def _of_joint(pairs: GainPairs, j: int) -> _Joint:
    torque, most = pairs.torque[:, j], float(pairs.added[j])
    if most < LEAST_TORQUE:
        return _Joint(reason=NO_TORQUE)
    current = pairs.current[:, j, None]
    line = instrumental(current, torque, torque[:, None], pairs.pose)
    gain, error = float(line.coefficients[0]), float(line.std_error[0])
    if not error < MOST_ERROR * abs(gain):
        estimate = f"{gain:.3g} ± {error:.2g} N·m/A"
        return _Joint(
            reason=f"the payloads add at most {most:.2g} N·m, too little compared with friction: "
            f"{estimate}"
        )
    if gain <= 0:
        return _Joint(reason=f"{gain:.3g} ± {error:.2g} N·m/A is not above 0: {NOT_POSITIVE}")
    both = np.column_stack([current, pairs.square[:, j]])
    bent = instrumental(both, torque, np.column_stack([torque, pairs.instrument[:, j]]), pairs.pose)
    (k1, k2), (k1_error, k2_error) = bent.coefficients.tolist(), bent.std_error.tolist()
    if not k2_error * pairs.largest[j] < MOST_BEND_ERROR * gain:
        return _Joint(gain, error)
    return _Joint(gain, error, k1, k1_error, k2, k2_error)


SAME_POSE_RAD = 0.01
"""Largest difference of joint positions between dwells of the same pose [rad]."""

ONE_SIDED = (
    "not all poses were approached from both directions: load-dependent friction remains in the "
    "gains, a few percent of them; record with approach: both"
)


@dataclass(frozen=True, slots=True, eq=False)
class GainPairs:
    """Differences between a heavier and the lightest payload, one row per pose and payload.

    Each row is the mean over the approach directions.

    Attributes:
        torque: (N, n) difference of torques from the payload and from the weight of the arm, whose
            positions may differ slightly between payloads [N·m].
        current: (N, n) difference of measured currents [A].
        square: (N, n) difference of i²·sign(i), with i the measured current [A²].
        instrument: (N, n) difference of τ·abs(τ), with τ the static torque of the robot model
            [N²·m²].
        pose: (N,) index of the pose of each row.
        added: (n,) largest additional torque of the payloads alone [N·m].
        largest: (n,) largest current [A].
        masses: Masses of the payloads [kg], ascending.
        both_sides: Whether every row is the mean of two approach directions.
        notes: List of notes for the user.
    """

    torque: FloatArray
    current: FloatArray
    square: FloatArray
    instrument: FloatArray
    pose: IntArray
    added: FloatArray
    largest: FloatArray
    masses: tuple[float, ...]
    both_sides: bool
    notes: tuple[str, ...]


def paired(dwells: Dataset, robot: RobotModel) -> GainPairs:
    """Return the differences between dwells with each heavier and with the lightest payload.

    An arm with a compliant controller stands a little lower with a payload, so its own weight
    causes different torques, always with the same sign. The masses of the robot model are used to
    correct the effect of these position differences. At a position difference of `SAME_POSE_RAD`,
    the weight of the arm changes the result by up to 3 % of the payload torque. If the masses of
    the robot model are wrong by 10 %, a tenth of this change remains after the correction.

    Raises:
        FitError: All dwells have the same payload.
    """
    loads = sorted({c.payload for c in dwells.conditions}, key=lambda load: (load.mass, load.com))
    if len(loads) < 2:
        have = f"{loads[0].mass:g} kg" if loads else "no dwells"
        raise FitError(
            f"drive gains need the same poses with at least two payloads, the data have {have} "
            "only",
            hint="set two `loads` in the spec, or pass both recordings together",
        )
    q, current = (series_means(dwells, dwells[name]) for name in ("q", "effort"))
    levels = np.stack([_torque(robot, q, load) for load in loads])
    number = {load: k for k, load in enumerate(loads)}
    load = np.array([number[c.payload] for c in dwells.conditions])
    own = levels[load, np.arange(len(load))]
    whole = own + robot.gravity(q)
    values = np.stack(
        [whole, current, current * np.abs(current), whole * np.abs(whole), own], axis=1
    )
    at = _poses(q)
    rows, poses, sides = _differences(dwells, at, load, values)
    # Two approaches are the directions +1 and −1. A pose of unknown direction only has approach 0.
    both = 2 in sides
    kept = [k for k, count in enumerate(sides) if count == (2 if both else 1)]
    stacked = np.array([rows[k] for k in kept]).reshape(-1, 5, dwells.n_joints)
    torque, amps, square, instrument, by_load = stacked.transpose(1, 0, 2)
    masses = tuple(load.mass for load in loads)
    pose = np.array([poses[k] for k in kept], dtype=np.int64)
    added, largest = (np.max(np.abs(x), axis=0, initial=0.0) for x in (by_load, current))
    notes = (*(() if both else (ONE_SIDED,)), *_left_out(set(at), set(pose.tolist()), both))
    return GainPairs(torque, amps, square, instrument, pose, added, largest, masses, both, notes)


def _torque(robot: RobotModel, q: FloatArray, load: Payload) -> FloatArray:
    if load.is_empty:
        return np.zeros_like(q)
    still = np.zeros_like(q)
    return robot.payload_effort(load, q, still, still)


def _poses(q: FloatArray) -> list[int]:
    """Return the pose index of each dwell; equal positions have equal indices in all recordings."""
    known = np.empty_like(q)
    numbers: list[int] = []
    count = 0
    for where in q:
        near = np.flatnonzero(np.max(np.abs(known[:count] - where), axis=1) < SAME_POSE_RAD)
        if not len(near):
            known[count], near, count = where, np.array([count]), count + 1
        numbers.append(int(near[0]))
    return numbers


def _differences(
    dwells: Dataset, poses: list[int], load: IntArray, values: FloatArray
) -> tuple[list[FloatArray], list[int], list[int]]:
    """Return difference of `values`, pose and approach count per pose and heavier payload."""
    at: dict[tuple[int, int], dict[int, int]] = {}
    for series, (pose, condition) in enumerate(zip(poses, dwells.conditions, strict=True)):
        # If a dwell was repeated in a later attempt, the last attempt is used.
        at.setdefault((pose, condition.approach), {})[int(load[series])] = series
    rises: dict[tuple[int, int], list[FloatArray]] = {}
    for (pose, _), under in at.items():
        for heavier in sorted(under.keys() - {0} if 0 in under else ()):
            rise = values[under[heavier]] - values[under[0]]
            rises.setdefault((pose, heavier), []).append(rise)
    rows = [np.mean(each, axis=0) for each in rises.values()]
    return rows, [pose for pose, _ in rises], [len(each) for each in rises.values()]


def _left_out(measured: set[int], used: set[int], both: bool) -> Iterator[str]:
    """Yield a note if some poses could not be used."""
    lost = len(measured - used)
    if lost:
        sides = "from both directions " if both else "from the same direction "
        yield (
            f"{lost} of {len(measured)} poses are not used: they were not approached {sides}with "
            "the lightest and with a heavier payload"
        )


NEEDED = ("torque_target", "effort_target", "qd")

LEAST_ROWS = 200

MOST_SPREAD = 0.03
"""Relative difference between the gains of several series above which a note is added."""


@dataclass(frozen=True, slots=True, eq=False)
class ControllerGains:
    """Drive gain of every joint that a controller uses; NaN if not determined.

    Attributes:
        joint_names: Names of the n joints.
        gain: (n,) drive gains [N·m/A].
        gain_error: (n,) standard errors, clustered by blocks of time of the residual.
        residual_share: (n,) residual RMS of the regression, as a share of the current RMS.
        reasons: Reason why the gain of each joint is not determined; empty for a determined gain.
        samples: Number of rows that the regression used.
        declared: (n,) gains that the recording declares; None without declared gains.
        notes: List of notes for the user.
    """

    method: ClassVar[str] = "controller"

    joint_names: tuple[str, ...]
    gain: FloatArray
    gain_error: FloatArray
    residual_share: FloatArray
    reasons: tuple[str, ...]
    samples: int
    declared: FloatArray | None
    notes: tuple[str, ...] = ()

    @property
    def determined(self) -> BoolArray:
        """Mask (n,) of the joints whose gain is determined."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def to_dict(self) -> dict[str, Any]:
        """Return the result for `hil drive-gains --json`; undetermined values are None."""
        named = zip(self.joint_names, self.reasons, strict=True)
        return {
            "method": self.method,
            "joint_names": list(self.joint_names),
            "gain_nm_a": listed(self.gain),
            "gain_error_nm_a": listed(self.gain_error),
            "residual_share": listed(self.residual_share),
            "not_determined": {name: reason for name, reason in named if reason},
            "samples": self.samples,
            "declared_nm_a": None if self.declared is None else listed(self.declared),
            "yaml": self.yaml_lines(),
            "notes": list(self.notes),
        }

    def yaml_lines(self) -> list[str]:
        """Return the YAML lines with drive gains and source, for a station or an import map.

        Joints whose gain is not determined keep the declared gain, if a gain is declared.
        """
        source = f"the controller's current per torque over {self.samples} samples"
        return gain_lines(self.joint_names, self.gain, self.reasons, self.declared, source)


def shows_controller(dataset: Dataset) -> bool:
    """Return whether a recording contains the columns that `controller_gains` needs."""
    return dataset.effort_kind == "current" and set(NEEDED) <= dataset.columns.keys()


SIGN_WIDTH = 0.01
"""Width w of tanh(q̇/w), which approximates sign(q̇) [rad/s]."""


def controller_gains(dataset: Dataset) -> ControllerGains:
    """Return drive gains from the commanded currents and torques of a controller.

    For this method, the payloads need not be known. A controller computes the torque of the
    commanded motion (`torque_target`) from its model of the arm and commands a current for this
    torque (`effort_target`), so it uses a drive gain internally. For each joint, the current is
    regressed on the torque and on friction terms,

        i = a·τ + b·tanh(q̇/w) + c·q̇ + d,

    The drive gain is 1/a, with a the coefficient of the torque. Current and torque both come from
    the controller, so a wrong payload declaration has no influence. The identified gain is the gain
    that the controller *assumes*; the manufacturer usually knows the gain better than a data sheet
    states it. For the UR10e recordings of Mamedov & Mikhel the result is 11.75 11.99 9.82 10.69
    10.33 10.9 N·m/A. For the UR10e recordings, the gains without payload and with 2.8 kg agree
    within 0.5 %.

    Args:
        dataset: Recording with the columns `effort_target` [A], `torque_target` [N·m] and `qd`, in
            which every joint moves. The payloads of the recording do not influence the gains.

    Raises:
        FitError: A column is missing or contains values that are not finite, the efforts are
            torques, or there are too few rows.
    """
    missing = [name for name in NEEDED if name not in dataset.columns]
    if missing or dataset.effort_kind != "current":
        what = f"lacks {', '.join(missing)}" if missing else "contains torques, not currents"
        raise FitError(
            "the drive gains of a controller are computed from its currents and torques, but the "
            f"recording {what}",
            hint="import it with a map that names torque_target and effort_target, or calibrate "
            "with known payloads",
        )
    data = dataset.of_kind("trajectory", "move")
    if len(data) < LEAST_ROWS or not all(np.isfinite(data[name]).all() for name in NEEDED):
        raise FitError(
            f"drive gains need at least {LEAST_ROWS} rows of motion, all with finite values; the "
            f"recording has {len(data)} rows",
            hint="pass recordings in which every joint moves",
        )
    joints = [_controller_joint(data, j) for j in range(data.n_joints)]
    notes = _spread_notes(data)
    return ControllerGains(
        joint_names=data.joint_names,
        gain=np.array([joint.gain for joint in joints]),
        gain_error=np.array([joint.error for joint in joints]),
        residual_share=np.array([joint.residual for joint in joints]),
        reasons=tuple(joint.reason for joint in joints),
        samples=len(data),
        declared=dataset.drive_gains,
        notes=tuple(notes),
    )


class _ControllerJoint(NamedTuple):
    gain: float = np.nan
    error: float = np.nan
    residual: float = np.nan
    reason: str = ""


def _controller_joint(data: Dataset, j: int) -> _ControllerJoint:
    X, current = _columns(data, j), data["effort_target"][:, j]
    if np.ptp(X[:, 0]) == 0 or not np.any(current):
        return _ControllerJoint(reason="the controller commands no torque or no current")
    line = weighted_least_squares(X, current)
    if line.rank < X.shape[1]:
        return _ControllerJoint(
            reason="the joint does not move, so friction cannot be separated from torque"
        )
    residual, slope = current - X @ line.coefficients, line.coefficients[0]
    blocks = time_blocks(residual[:, None], data.offsets)
    sums = ClusterSums.of(X, residual, np.ones(len(X)), blocks)
    variance = clustered_covariance(line.bread, sums).covariance[0, 0]
    gain, error = 1.0 / slope, np.sqrt(variance) / slope**2
    share = float(np.sqrt(np.mean(residual**2) / np.mean(current**2)))
    estimate = f"{gain:.3g} ± {error:.2g} N·m/A"
    if slope <= 0 or not error < MOST_ERROR * gain:
        return _ControllerJoint(
            residual=share,
            reason=f"the commanded current does not follow the commanded torque: {estimate}",
        )
    return _ControllerJoint(float(gain), float(error), share)


def _columns(data: Dataset, j: int) -> FloatArray:
    friction = friction_terms(data["qd"], SIGN_WIDTH).values()
    return np.column_stack([data["torque_target"][:, j], *(term[:, j] for term in friction)])


def _spread_notes(data: Dataset) -> Iterator[str]:
    """Yield a note for each joint whose drive gain differs between series."""
    if len(data.conditions) < 2:
        return
    parts = [part for i in range(len(data.conditions)) if len(part := data.take([i])) >= LEAST_ROWS]
    for j, name in enumerate(data.joint_names):
        gains = [joint.gain for part in parts if not (joint := _controller_joint(part, j)).reason]
        if len(gains) > 1 and np.ptp(gains) > MOST_SPREAD * np.mean(gains):
            spread = f"{min(gains):.2f} to {max(gains):.2f} N·m/A"
            yield f"{name}: the gain varies between series from {spread}"
