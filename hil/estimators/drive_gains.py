"""Drive gains, the torque per motor current of every joint: where they come from and where they go.

A fit in torques needs them, and data sheets rarely have them. Two measurements find them:
`calibrate_gains` from loads of known mass (`Gains`), `controller_gains` from what a controller
commands (`ControllerGains`). Either result prints the lines of YAML that a station or an import map
takes; `write_gains` and `read_gains` keep them in a file (`hil gains -o`, `hil fit --gains`), and
`DriveGains.of` puts them into a recording. The gain is the slope of the drive's curve at no
current, which is in `hil.estimators.drive_curve`.
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
    """Torque per current of every joint.

    Attributes:
        values: (n,) [N·m/A], above 0.
        source: Where they come from.
    """

    values: FloatArray
    source: str

    def of(self, dataset: Dataset) -> Dataset:
        """The recording with these gains instead of those it declares.

        Raises:
            DataError: They are of another number of joints, or the recording holds torques.
        """
        if dataset.effort_kind != "current":
            raise DataError(
                "drive gains turn currents into torques, but the recording holds torques",
                hint="leave the gains out",
            )
        if len(self.values) != dataset.n_joints:
            raise DataError(
                f"{len(self.values)} drive gains were given for {dataset.n_joints} joints",
                hint="give one per joint, base to flange",
            )
        return replace(dataset, drive_gains=self.values, drive_gains_source=self.source)


def read_gains(path: Path) -> DriveGains:
    """The gains in a YAML file: those of `hil gains -o`, of an import map, or of your own.

    Raises:
        SpecError: The file cannot be read, or has no `drive_gains_nm_a` of positive numbers.
    """
    content = read_source(path).data
    document = content if isinstance(content, dict) else {}
    listed_gains = document.get(KEY)
    numbers = listed_gains if isinstance(listed_gains, list) else []
    if not numbers or not all(_is_gain(number) for number in numbers):
        raise SpecError(
            f"{path}: holds no {KEY}: a list of numbers above 0, one per joint",
            hint="write it with: hil gains SOURCE -o gains.yaml",
        )
    source = str(document.get(SOURCE_KEY) or path.name)
    return DriveGains(np.array(numbers, dtype=np.float64), source)


def _is_gain(number: object) -> bool:
    if isinstance(number, bool) or not isinstance(number, int | float):
        return False
    return bool(np.isfinite(number)) and number > 0


def write_gains(path: Path, lines: Sequence[str]) -> None:
    """Write the lines of `Gains.yaml_lines`.

    Raises:
        DataError: There are none: a joint's gain is not known.
        RecordingError: The file exists already.
    """
    if not lines:
        raise DataError(
            "the gains of some joints are not known, so no file was written",
            hint="declare gains in the import map; joints that do not tell keep those",
        )
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write("\n".join(lines) + "\n")
    except FileExistsError:
        raise RecordingError(f"{path} exists already", hint="choose another -o") from None


KEPT = "as declared before"
"""In the source of the gains, of joints whose gain was not determined."""

CALIBRATED = ("calibrated with ", "the controller's current per torque ")
"""What the sources begin with that `hil gains` writes."""


def calibrated(source: str) -> bool:
    """Whether gains of this source were all measured on the arm itself."""
    return source.startswith(CALIBRATED) and KEPT not in source


def gain_lines(
    names: tuple[str, ...],
    gain: FloatArray,
    reasons: tuple[str, ...],
    declared: FloatArray | None,
    source: str,
) -> list[str]:
    """`drive_gains_nm_a` and its source for a station or an import map.

    Args:
        names: Length n, the joints.
        gain: (n,) measured gains [N·m/A].
        reasons: Length n, why a joint's gain is not determined; empty where it is.
        declared: (n,) gains that joints which were not determined keep, or None: then there are
            no lines unless all were, because a map needs a gain for every joint.
        source: Where the gains come from, in words.
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
    """Numbers for JSON; what is not determined is null."""
    return [float(value) if np.isfinite(value) else None for value in values]


LEAST_POSES = 5

LEAST_TORQUE = 0.01
"""Torques below this [N·m] are rounding of the load's geometry."""

NO_TORQUE = (
    "the loads add no torque about its axis: it is vertical, or goes through their centres of mass"
)

MOST_ERROR = 0.05
"""Relative standard error of a gain beyond which it is not called determined. A gain that passes is
twenty standard errors away from 0."""

NOT_POSITIVE = (
    "the current falls where the loads' torque rises: the current or the joint counts in the other "
    "direction than the robot model, or the mass or centre of a load is wrong"
)

MOST_BEND_ERROR = 0.03
"""Standard error of K₂·i at the largest current, as a share of the gain; beyond it K₂ says nothing
about a drive, which bends by a few percent."""


@dataclass(frozen=True, slots=True, eq=False)
class Gains:
    """Torque per current of every joint, NaN where the loads do not tell.

    Attributes:
        joint_names: Length n.
        gain: (n,) torque the loads add per current they add [N·m/A]: what a linear model needs.
        gain_error: (n,) its standard error, clustered by pose, given exact loads.
        k1, k1_error: (n,) K₁ of eq. 16, the gain at no current [N·m/A].
        k2, k2_error: (n,) K₂ of eq. 16 [N·m/A²].
        reasons: Why a joint's gain is not determined; empty where it is.
        masses: The loads [kg].
        poses: How many poses were compared.
        both_sides: Whether each was approached from both sides.
        declared: (n,) gains the recording declares, or None.
        notes: What else to know, for people.
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
        """(n,) which gains the loads tell."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil gains --json`; what is not determined is null."""
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
        """`drive_gains_nm_a` and its source for a station or an import map.

        Joints that were not determined keep the gain the recording declares.
        """
        masses = ", ".join(f"{mass:g}" for mass in self.masses)
        source = f"calibrated with {masses} kg at {self.poses} poses"
        return gain_lines(self.joint_names, self.gain, self.reasons, self.declared, source)


def calibrate_gains(dataset: Dataset, robot: RobotModel) -> Gains:
    """Drive gains from dwells at the same poses under at least two loads of known mass.

    What the load adds to a joint's torque follows from its mass, its centre and the positions; what
    it adds to the current is measured. Everything else cancels in the difference: the arm's own
    gravity, offsets, and the friction that a dwell is left with, which the same pose approached the
    same way leaves nearly alike.

    Friction that grows with the transmitted torque does not cancel: approached from below, a joint
    holds a few percent of the load by friction, from above as many percent more by current. The
    mean of both approaches is free of it; with one approach only, it stays in the gain and a note
    says so.

    Currents carry the noise, torques are exact. Torque regressed on current would give gains that
    are too small; so the torques serve as instruments (two-stage least squares): for eq. 16
    differenced, Δτ = K₁·Δi + K₂·Δ(i²·sign i), they are Δτ itself and Δ(τ̂·abs(τ̂)) of the robot
    model's own τ̂.

    Args:
        dataset: Motor currents; each series' *declared* load is taken as exact.
        robot: Kinematics say what torque a load makes. Masses serve as instruments, and where a
            pose under load is a little off, for what that changes.

    Raises:
        FitError: The efforts are no currents, not finite, of another robot or cannot be; or there
            are not two loads at five poses that were approached the same way.
    """
    if dataset.effort_kind != "current":
        raise FitError(
            f"drive gains are torque per current, the data hold a {dataset.effort_kind}",
            hint="record motor currents",
        )
    require_robot(dataset, robot)
    require_clean(dataset, ("t", "q", "effort"))
    require_plausible(dataset, robot)
    pairs = paired(dwells_of(dataset), robot)
    poses = len(set(pairs.pose.tolist()))
    if poses < LEAST_POSES:
        raise FitError(
            f"{poses} poses with two loads and the same approach are too few: gains need at least "
            f"{LEAST_POSES}, better 40",
            hint="run experiments/ur5_gains.yaml, or the same dwell program with each load",
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
            reason=f"the loads add at most {most:.2g} N·m, too little against friction: {estimate}"
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
"""Positions further apart are another pose."""

ONE_SIDED = (
    "poses were not approached from both sides: friction that grows with the load is part of the "
    "gains, a few percent of them; record with approach: both"
)


@dataclass(frozen=True, slots=True, eq=False)
class GainPairs:
    """What a load adds to the lightest one, a row per pose and load (approaches averaged).

    Attributes:
        torque: (N, n) by the load's mass and centre, and by the arm's weight where the load made
            it stand elsewhere [N·m].
        current: (N, n) measured [A].
        square: (N, n) the same of i²·sign(i) [A²].
        instrument: (N, n) the same of τ·abs(τ), τ by the robot model at rest [N²·m²].
        pose: (N,) number of the pose.
        added: (n,) the most that the loads themselves add [N·m].
        largest: (n,) largest current [A].
        masses: The loads [kg], ascending.
        both_sides: Whether every row is the mean of both approaches.
        notes: For people.
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
    """Pair the dwells of each heavier load with those of the lightest one.

    An arm whose controller gives way stands a little lower with a load, and its own weight then
    pulls differently, always in the same sense. The robot model says by how much, so that is taken
    into account; at `SAME_POSE_RAD` it is up to 3 % of what a load adds, and masses that are a
    tenth wrong leave a tenth of that.

    Raises:
        FitError: All dwells are under the same load.
    """
    loads = sorted({c.payload for c in dwells.conditions}, key=lambda load: (load.mass, load.com))
    if len(loads) < 2:
        have = f"{loads[0].mass:g} kg" if loads else "no dwells"
        raise FitError(
            f"gains need the same poses under at least two loads, the data have {have} only",
            hint="give the spec two `loads`, or fit both recordings together",
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
    # Approached from both sides: +1 and −1. Where it is not known, a pose has the approach 0 only.
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
    """Number of the pose each dwell is at; recordings of different loads number theirs apart."""
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
    """Per pose and heavier load: difference of `values`, pose, and how many approaches."""
    at: dict[tuple[int, int], dict[int, int]] = {}
    for series, (pose, condition) in enumerate(zip(poses, dwells.conditions, strict=True)):
        # Of a dwell that was measured again in a later attempt, the last one counts.
        at.setdefault((pose, condition.approach), {})[int(load[series])] = series
    rises: dict[tuple[int, int], list[FloatArray]] = {}
    for (pose, _), under in at.items():
        for heavier in sorted(under.keys() - {0} if 0 in under else ()):
            rise = values[under[heavier]] - values[under[0]]
            rises.setdefault((pose, heavier), []).append(rise)
    rows = [np.mean(each, axis=0) for each in rises.values()]
    return rows, [pose for pose, _ in rises], [len(each) for each in rises.values()]


def _left_out(measured: set[int], used: set[int], both: bool) -> Iterator[str]:
    """A note when there are poses that tell nothing."""
    lost = len(measured - used)
    if lost:
        sides = "from both sides " if both else "the same way "
        yield (
            f"{lost} of {len(measured)} poses are left out: they were not approached {sides}with "
            "the lightest and with a heavier load"
        )


NEEDED = ("torque_target", "effort_target", "qd")

LEAST_ROWS = 200

MOST_SPREAD = 0.03
"""Series whose gains differ by more than this share get a note."""


@dataclass(frozen=True, slots=True, eq=False)
class ControllerGains:
    """Torque per current of every joint as the controller has it; NaN where it does not show.

    Attributes:
        joint_names: Length n.
        gain: (n,) [N·m/A].
        gain_error: (n,) standard error, by blocks of time of the residual.
        residual_share: (n,) RMS of what the regression leaves, as a share of the current's.
        reasons: Why a joint's gain is not determined; empty where it is.
        samples: Rows used.
        declared: (n,) gains the recording declares, or None.
        notes: What else to know, for people.
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
        """(n,) which gains the recording tells."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    def to_dict(self) -> dict[str, Any]:
        """The contract of `hil gains --json`; what is not determined is null."""
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
        """`drive_gains_nm_a` and its source; undetermined joints keep what is declared, if any."""
        source = f"the controller's current per torque over {self.samples} samples"
        return gain_lines(self.joint_names, self.gain, self.reasons, self.declared, source)


def shows_controller(dataset: Dataset) -> bool:
    """Whether a recording has what `controller_gains` needs."""
    return dataset.effort_kind == "current" and set(NEEDED) <= dataset.columns.keys()


SIGN_WIDTH = 0.01
"""Width w of the tanh that stands for sign(qd) [rad/s]."""


def controller_gains(dataset: Dataset) -> ControllerGains:
    """Drive gains from the controller's own currents and torques, no load being known.

    A controller that computes the torque of the motion it commands (`torque_target`, from its model
    of the arm) and commands a current for it (`effort_target`) knows a gain. Per joint its current
    is regressed on its torque and on what it adds against friction,

        i = a·τ + b·tanh(q̇/w) + c·q̇ + d,

    and the gain is 1/a. Both sides are the controller's own, so it does not matter whether the load
    it was given is right; the result is the gain *it believes in*, of which its maker knows more
    than a data sheet. On the UR10e recordings of Mamedov & Mikhel this gives 11.75 11.99 9.82 10.69
    10.33 10.9 N·m/A, unloaded and with 2.8 kg alike within 0.5 %.

    Args:
        dataset: With the columns `effort_target` [A], `torque_target` [N·m] and `qd`; the arm
            has to move. Loads do not matter.

    Raises:
        FitError: A column is missing, holds no numbers, or there are too few rows.
    """
    missing = [name for name in NEEDED if name not in dataset.columns]
    if missing or dataset.effort_kind != "current":
        what = f"lacks {', '.join(missing)}" if missing else "holds torques, no currents"
        raise FitError(
            f"the controller's gains follow from its currents and torques; the recording {what}",
            hint="import it with a map that names torque_target and effort_target, or calibrate "
            "with known loads",
        )
    data = dataset.of_kind("trajectory", "move")
    if len(data) < LEAST_ROWS or not all(np.isfinite(data[name]).all() for name in NEEDED):
        raise FitError(
            f"{len(data)} rows of motion tell no gains: at least {LEAST_ROWS} are needed, all of "
            "them with numbers",
            hint="give recordings in which every joint moves",
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
        return _ControllerJoint(reason="the controller asks for no torque or no current")
    line = weighted_least_squares(X, current)
    if line.rank < X.shape[1]:
        return _ControllerJoint(reason="it does not move, so friction cannot be told from torque")
    residual, slope = current - X @ line.coefficients, line.coefficients[0]
    blocks = time_blocks(residual[:, None], data.offsets)
    sums = ClusterSums.of(X, residual, np.ones(len(X)), blocks)
    variance = clustered_covariance(line.bread, sums).covariance[0, 0]
    gain, error = 1.0 / slope, np.sqrt(variance) / slope**2
    share = float(np.sqrt(np.mean(residual**2) / np.mean(current**2)))
    estimate = f"{gain:.3g} ± {error:.2g} N·m/A"
    if slope <= 0 or not error < MOST_ERROR * gain:
        return _ControllerJoint(
            residual=share, reason=f"its current does not follow its torque: {estimate}"
        )
    return _ControllerJoint(float(gain), float(error), share)


def _columns(data: Dataset, j: int) -> FloatArray:
    friction = friction_terms(data["qd"], SIGN_WIDTH).values()
    return np.column_stack([data["torque_target"][:, j], *(term[:, j] for term in friction)])


def _spread_notes(data: Dataset) -> Iterator[str]:
    """A note for joints whose gain depends on which series one asks."""
    if len(data.conditions) < 2:
        return
    parts = [part for i in range(len(data.conditions)) if len(part := data.take([i])) >= LEAST_ROWS]
    for j, name in enumerate(data.joint_names):
        gains = [joint.gain for part in parts if not (joint := _controller_joint(part, j)).reason]
        if len(gains) > 1 and np.ptp(gains) > MOST_SPREAD * np.mean(gains):
            yield f"{name}: series by series {min(gains):.2f} to {max(gains):.2f} N·m/A"
