"""Rigid-body dynamics with hysteretic, load-dependent friction that is selected by the data.

Classical friction models have no memory. The friction of a joint that reverses or stands still
depends on the last millirad of its path. In `rigid-hysteresis`, Dahl's states, computed along the
measured path, replace sign(v). Friction increases with the torque through the gear, and gears and
motors cause ripple.

A fit of `rigid-hysteresis` has four steps (`RigidHysteresis._learn`):

1. The rigid body is fitted with basic friction, which gives the torque through every gear.
2. The shapes of the friction of each joint (lengths, Stribeck speeds, exponents) are fitted by
   variable projection.
3. The columns of the friction library and the rigid-body regressor are compressed per trajectory.
   Cross-validation over trajectories selects the groups of columns and the penalty of each joint.
4. All coefficients are fitted together, and then the physically consistent links.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from hil.arms import Payload
from hil.core import BoolArray, DataError, FloatArray, IntArray, SpecError, did_you_mean
from hil.data import (
    AT_REST,
    MOTION,
    Conditions,
    Dataset,
    FilterSettings,
    Prediction,
    SeriesKind,
    Stream,
    derivative,
    downsampling_mask,
    rows_to_fit,
    sample_rate,
)
from hil.dynamics import BaseParameters, RobotModel, base_parameters
from hil.estimators.base import RobotEstimator, chunks, payload_torque, prepared
from hil.estimators.checks import (
    Needs,
    require_clean,
    require_motion,
    require_plausible,
    require_rank,
    require_robot,
    require_sizes,
    torque_scale,
)
from hil.estimators.consistent import IDENTIFY
from hil.estimators.friction_fit import (
    AS_GOOD,
    Block,
    Observed,
    Part,
    Solved,
    Through,
    climb,
    consistent_links,
    first_shapes,
    fitted_shapes,
    folds_of,
    observe,
    solve,
)
from hil.estimators.friction_library import (
    CORE,
    LEAST_LOAD,
    LOADED,
    MULTIPLES,
    Columns,
    FrictionLaw,
    FrictionMotion,
    Shapes,
    groups,
    motions,
    predicted_friction,
    rungs,
    smoothed,
    temperatures_vary,
    usual_temperatures,
)
from hil.estimators.friction_memory import path_steps
from hil.estimators.inertial_bounds import InertialBounds
from hil.estimators.parameters import flag, number, parameter, settings
from hil.estimators.streaming import DahlMemory, SampleStream

FRICTION_SAMPLES = 10
"""Minimum number of samples per joint for its friction, besides the samples for the links."""


def _group_names(name: str, value: str | Sequence[str]) -> str | tuple[str, ...]:
    """Return `auto` or the names of groups, to which the group `core` is always added.

    Raises:
        SpecError: A named group does not exist.
    """
    if value == "auto":
        return "auto"
    if not isinstance(value, Sequence):
        raise SpecError(f"{name} is {value!r:.60}, but must be auto or a list of groups")
    known = groups(ripple=True, temperature=True)
    chosen = (value,) if isinstance(value, str) else tuple(value)
    for group in chosen:
        if not isinstance(group, str) or group not in known:
            words = ["auto", *known]
            raise SpecError(
                f"{name}: unknown group {group!r}",
                hint=did_you_mean(str(group), words) or f"known groups: {', '.join(words)}",
            )
    return tuple(dict.fromkeys((CORE, *chosen)))


class RigidHysteresis(RobotEstimator):
    """Default estimator for dynamics: physically consistent links and friction with memory.

    Attributes:
        rigid_: (b,) base parameters.
        inertial_: (11n,) physically consistent inertial parameters; None unless `consistent` is
            set.
        law_: Fitted law of friction, ripple and drive effects.
        filters_: Filter settings that the fit used.
        gear_rigid_: (b,) base parameters with which the torque through the gears was computed.
        held_out_: (n,) cross-validation error of the filtered effort over trajectories, in effort
            units. The trajectories of this cross-validation were also used to select the groups.
        parameter_names_: Names of base parameters, followed by the friction parameters of every
            joint.
    """

    estimator: ClassVar[str] = "rigid-hysteresis"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",), ("move",))

    friction: str | tuple[str, ...] = parameter(
        "auto",
        _group_names,
        doc="`auto`: one of a few nested lists of groups per joint, selected by cross-validation "
        "over the training trajectories; or a list of groups for all joints.",
    )
    fit_shapes: bool = parameter(
        True,
        flag,
        doc="Fit friction lengths, Stribeck speeds and exponents; False uses the default values.",
    )
    consistent: bool = parameter(
        True, flag, doc="Make the links physically consistent; needs the extra `identify`."
    )
    gear_ratio: float | None = parameter(
        None,
        number,
        above=0,
        optional=True,
        doc="Motor turns per joint turn, for ripple; by default those of the arm description, if "
        "known.",
    )
    filters: FilterSettings | None = parameter(
        None,
        settings,
        FilterSettings,
        optional=True,
        doc="Preprocessing for training and prediction; by default cut-offs of 11 Hz for motion "
        "and 17.6 Hz for effort at any sample rate, and higher cut-offs for faster motions.",
    )

    inertial_: FloatArray

    def extras(self) -> dict[str, str]:
        """Return the optional dependency for semidefinite programming if `consistent` is set."""
        purpose = f"{IDENTIFY['identify']}; not needed with consistent: false"
        return {"identify": purpose} if self.consistent else {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return the minimum data requirements: number of samples, and drive gains."""
        rank = base_parameters(robot, rotor=True).rank
        return Needs({"samples": rank + FRICTION_SAMPLES * robot.n}, gains=True)

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit the model to all series; declared payloads add to the torque through the gears.

        Raises:
            FitError: The data are too few, not finite, or are of a different robot or unit, contain
                impossible efforts, or do not excite all parameters.
            DataError: A series cannot be filtered.
            PluginError: The optional dependency `identify` is not installed.
        """
        require_robot(dataset, robot)
        self._remember(dataset, robot, torque_scale(dataset))
        require_clean(dataset, ("t", "q", "effort"))
        require_plausible(dataset, robot)
        self._base = base_parameters(robot, rotor=True)
        self.needs(robot).require(samples=len(dataset))
        require_motion(dataset)
        self.filters_ = self.filters or filters_for(dataset)
        data = prepared(dataset, self.filters_)
        self._learn(data)
        scatter = (data["effort"] - data["effort_f"])[rows_to_fit(data)]
        self.sigma_ = np.sqrt(self.held_out_**2 + np.mean(scatter**2, axis=0))
        self._name_parameters()
        return self

    def _learn(self, data: Dataset) -> None:
        """Fit the model to prepared data in the four steps, and set the fitted attributes."""
        robot, base, turns = self.robot_, self._base, motor_turns(self.robot_, self.gear_ratio)
        training = TrainingData.of(data, self.filters_, robot, base, self.torque_scale_)
        ripple = bool(np.any(np.isfinite(turns)))
        library = groups(ripple=ripple, temperature=temperatures_vary(data))
        shapes = first_shapes(turns)

        def rigid_with(names: Sequence[str], gear: FloatArray | None) -> FloatArray:
            """Return (b,) base parameters, fitted with these groups and `core` for every joint."""
            chosen = {name: library[name] for name in (CORE, *names)}
            observed = training.observed(chosen, gear, shapes)
            return solve(observed, [tuple(chosen)] * observed.joints).rigid

        # Steps 1 and 2: the friction columns depend on the torque through the gears. The rigid body
        # is therefore fitted again after this torque is known, and again with the fitted shapes.
        gear_rigid = rigid_with(BACKBONE, rigid_with(["speed p"], None))
        if self.fit_shapes:
            shapes = fitted_shapes(training.rest(gear_rigid, shapes), shapes)
            gear_rigid = rigid_with(BACKBONE, gear_rigid)
        # Step 3. If folds are parts of one trajectory, a richer list must have a smaller error.
        offered, ladders = _offered(training, library, self.friction, gear_rigid)
        observed = training.observed(offered, gear_rigid, shapes)
        found = climb(observed, ladders, as_good=AS_GOOD if training.whole else 0.0)
        # Step 4.
        solved = solve(observed, found.chosen, found.penalty)
        _require_excited(solved, base)
        self.notes_ = _notes(training, library, self.friction)
        if self.consistent:
            bounds = InertialBounds.nominal(robot)
            solved = consistent_links(solved, observed, found.chosen, base, bounds)
            assert solved.inertial is not None
            self.inertial_ = solved.inertial
            self.notes_ += _bound_notes(bounds, solved, robot.joint_names)
        self.rigid_, self.gear_rigid_ = solved.rigid, gear_rigid
        celsius = usual_temperatures(data)
        self.law_ = FrictionLaw(found.chosen, solved.friction, shapes, celsius)
        self.held_out_ = found.error * np.maximum(solved.grown, 1.0) / self.torque_scale_
        self.samples_ = int(training.kept.sum())

    def predict(self, dataset: Dataset) -> Prediction:
        """Return the effort of every row with the components of the model.

        The components of the effort are `gravity`, `inertia`, `friction`, `ripple`, `drive` and
        `payload`. The predicted friction is filtered like the motion from which it is computed.

        Raises:
            DataError: The data are of a different robot or unit, or cannot be filtered.
        """
        self.require_match(dataset)
        data = prepared(dataset, self.filters_)
        motion = tuple(data[name] for name in MOTION)
        load = payload_torque(self.robot_, data, *motion)
        torque, gravity, transmitted = self._rigid_torques(data, load)
        parts = {"gravity": gravity, "inertia": torque - gravity, "payload": load}
        parts |= predicted_friction(self.law_, data, transmitted, self.filters_)
        parts = {name: part / self.torque_scale_ for name, part in parts.items()}
        effort: FloatArray = np.sum(list(parts.values()), axis=0)
        std = np.broadcast_to(self.sigma_, effort.shape)
        return Prediction(effort, std, np.isfinite(effort), parts)

    def stream(self, payload: Payload | None = None) -> Stream:
        """Return a predictor for one sample at a time, with its friction states.

        The predictor does not filter its input, which should be as smooth as the training motion.
        """
        load, law = payload or Payload(), self.law_
        celsius = None if law.celsius is None else law.celsius[None]

        def effort(
            q: FloatArray, qd: FloatArray, qdd: FloatArray, states: Mapping[float, FloatArray]
        ) -> FloatArray:
            Y = self._base.regressor(self.robot_, q, qd, qdd)
            carried = np.zeros_like(q)
            if not load.is_empty:
                carried = self.robot_.payload_effort(load, q, qd, qdd)
            rigid, transmitted = (
                (Y @ beta).reshape(q.shape) + carried for beta in (self.rigid_, self.gear_rigid_)
            )
            here = FrictionMotion(q, qd, transmitted, law.shapes, celsius=celsius, given=states)
            torque: FloatArray = rigid + sum(law.torques(here).values())
            return torque / self.torque_scale_

        memory = DahlMemory(law.shapes.length, MULTIPLES)
        return SampleStream(self.robot_.n, memory, effort)

    def break_away(self) -> FloatArray:
        """Return (n,) the friction [N·m] that an unloaded static joint can hold."""
        return self.law_.break_away()

    def _rigid_torques(
        self, data: Dataset, load: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return rigid-body torque, its gravity component and gear torque, each (N, n) [N·m]."""
        torque, gravity, transmitted = (np.empty_like(load) for _ in range(3))
        for rows in chunks(data):
            q, qd, qdd = (data[name][rows] for name in MOTION)
            still = np.zeros_like(q)
            Y = self._base.regressor(self.robot_, q, qd, qdd)
            torque[rows] = (Y @ self.rigid_).reshape(q.shape)
            transmitted[rows] = (Y @ self.gear_rigid_).reshape(q.shape) + load[rows]
            at_rest = self._base.regressor(self.robot_, q, still, still)
            gravity[rows] = (at_rest @ self.rigid_).reshape(q.shape)
        return torque, gravity, transmitted

    def fitted_arrays(self) -> dict[str, FloatArray]:
        """Return rigid-body parameters, friction, shapes, torque scale and deviations as arrays."""
        arrays = {
            "rigid": self.rigid_,
            "gear_rigid": self.gear_rigid_,
            "friction": np.concatenate(self.law_.coefficients),
            "shapes": self.law_.shapes.to_array(),
            "held_out": self.held_out_,
            "torque_scale": self.torque_scale_,
            "sigma": self.sigma_,
        }
        if self.law_.celsius is not None:
            arrays["celsius"] = self.law_.celsius
        inertial = getattr(self, "inertial_", None)
        return arrays if inertial is None else arrays | {"inertial": inertial}

    def fitted_facts(self) -> dict[str, Any]:
        """Return the names of all parameters, the groups of each joint and the filter settings."""
        return super().fitted_facts() | {
            "parameter_names": list(self.parameter_names_),
            "friction": [list(names) for names in self.law_.chosen],
            "filters": self.filters_.model_dump(),
        }

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Restore the fitted attributes from the output of `fitted_arrays` and `fitted_facts`."""
        self._restore_common(arrays, facts)
        self._base = base_parameters(self.robot_, rotor=True)
        self.rigid_, self.gear_rigid_ = arrays["rigid"], arrays["gear_rigid"]
        if not self.rigid_.shape == self.gear_rigid_.shape == (self._base.rank,):
            raise ValueError(f"rigid: {self.rigid_.size} values for {self._base.rank} parameters")
        self.held_out_ = arrays["held_out"]
        self.filters_ = FilterSettings.model_validate(facts["filters"])
        if "inertial" in arrays:
            self.inertial_ = arrays["inertial"]
            require_sizes(self, inertial=11 * self.robot_.n)
        chosen = tuple(tuple(map(str, names)) for names in facts["friction"])
        self.law_ = FrictionLaw.from_flat(
            chosen,
            arrays["friction"],
            Shapes.from_array(arrays["shapes"]),
            arrays.get("celsius"),
        )
        self._name_parameters()

    def _name_parameters(self) -> None:
        self.parameter_names_ = (*self._base.names, *self.law_.parameter_names(self.joint_names_))


MOTION_HZ, EFFORT_RATIO = 11.0, 1.6
"""Lowest cut-off of velocity and acceleration [Hz], and ratio of the effort cut-off to this value.

The motion cut-off does not depend on the sample rate, because the motion of an arm has the same
frequencies at every sample rate. The effort cut-off is higher than the motion cut-off, because
ripple is visible at higher frequencies. The cut-off values were chosen by cross-validation on four
UR10e trajectories.
"""

BANDWIDTHS = 5.0
"""Minimum ratio of the cut-off to the bandwidth of the motion, for fast arms."""

ENERGY = 0.999
"""Share of the energy of the velocity that defines its bandwidth."""

MOST_OF_NYQUIST = 0.75


def filters_for(dataset: Dataset) -> FilterSettings:
    """Return filter settings for the bandwidth of the training motion.

    Raises:
        DataError: The time stamps of a series do not increase.
    """
    bandwidth, nyquist = 0.0, np.inf
    for condition, rows in dataset.slices():
        if condition.kind not in AT_REST and rows.stop - rows.start > 2:
            t = dataset["t"][rows]
            nyquist = min(nyquist, 0.5 * sample_rate(t))
            # Measured velocity is preferred, because position differences contain much noise.
            measured = dataset["qd"][rows] if "qd" in dataset.columns else None
            velocity = derivative(dataset["q"][rows], t) if measured is None else measured
            bandwidth = max(bandwidth, _bandwidth(velocity, t))
    most = MOST_OF_NYQUIST * nyquist / EFFORT_RATIO
    motion = round(float(min(max(MOTION_HZ, BANDWIDTHS * bandwidth), most)), 2)
    effort = round(EFFORT_RATIO * motion, 2)
    return FilterSettings(unit="hz", velocity=motion, acceleration=motion, effort=effort)


def _bandwidth(velocity: FloatArray, t: FloatArray) -> float:
    """Return the bandwidth of velocities (N, n) [Hz], as the median over the joints.

    The bandwidth of a joint contains the share `ENERGY` of the energy of its velocity.
    """
    from scipy.signal import welch

    rate = sample_rate(t)
    length = min(len(t), int(4.0 * rate))
    if length < 2:
        raise DataError(
            f"a sample rate of {rate:.3g} Hz is too low to determine the bandwidth of a motion",
            hint="check the unit of the time stamps, which must be seconds",
        )
    frequency, power = welch(velocity, rate, nperseg=length, axis=0)
    share = np.cumsum(power, axis=0) / np.maximum(np.sum(power, axis=0), 1e-300)
    return float(np.median(frequency[np.argmax(share >= ENERGY, axis=0)]))


def motor_turns(robot: RobotModel, gear_ratio: float | None) -> FloatArray:
    """Return (n,) the motor turns per joint turn; NaN if unknown."""
    if gear_ratio is not None:
        return np.full(robot.n, gear_ratio)
    if robot.arm is None:
        return np.full(robot.n, np.nan)
    return np.asarray(robot.arm.gear_ratio, dtype=np.float64)


NO_TRAJECTORIES = (
    "one trajectory only: friction columns were selected on held-out parts of this trajectory, "
    "which are less independent than a second trajectory"
)

WORSE = 1.2
"""Maximum ratio by which the bounds on links increase the error of a joint without a note."""

BACKBONE = ("load", "stribeck", "speed p")
"""Groups of friction columns that are used while the shapes are fitted."""


def _offered(
    training: TrainingData,
    library: Mapping[str, Columns],
    friction: str | Sequence[str],
    gear_rigid: FloatArray,
) -> tuple[dict[str, Columns], list[list[tuple[str, ...]]]]:
    """Return the groups of columns to compute, and the lists of groups possible for each joint."""
    if friction != "auto":
        names = tuple(name for name in friction if name in library)
        return {name: library[name] for name in names}, [[names]] * training.data.n_joints
    ladder = rungs(ripple="ripple 1" in library, temperature="temperature" in library)
    unloaded = [tuple(name for name in names if name not in LOADED) for names in ladder]
    shares = training.load_share(gear_rigid)
    ladders = [ladder if share >= LEAST_LOAD else unloaded for share in shares]
    return {name: library[name] for name in ladder[-1]}, ladders


def _notes(
    training: TrainingData, library: Mapping[str, Columns], friction: str | Sequence[str]
) -> tuple[str, ...]:
    """Return notes for the user about the selection of friction groups."""
    notes = [] if training.whole else [NO_TRAJECTORIES]
    missing = [] if friction == "auto" else [name for name in friction if name not in library]
    if missing:
        left_out = ", ".join(missing)
        notes.append(
            "groups left out, because motor turns are unknown or temperatures do not "
            f"vary: {left_out}"
        )
    return tuple(notes)


def _require_excited(solved: Solved, base: BaseParameters) -> None:
    weighted = solved.weighted
    X, _ = weighted.weighted_system()
    names = (*base.names, *(f"friction {i}" for i in range(X.shape[1] - base.rank)))
    require_rank(weighted.rank, weighted.condition, names, X, highest=1e8)


def _bound_notes(
    bounds: InertialBounds, solved: Solved, joint_names: tuple[str, ...]
) -> tuple[str, ...]:
    """Return notes on links at their bounds, and on the error increase caused by the bounds."""
    assert solved.inertial is not None
    notes = bounds.notes + bounds.reached(solved.inertial, joint_names)
    worst = float(np.max(solved.grown))
    if worst > WORSE:
        joint = joint_names[int(np.argmax(solved.grown))]
        notes += (
            f"physically consistent links make the error of {joint} {worst:.2g} times larger: if "
            "the payload and the nominal robot model are correct, try consistent: false",
        )
    return notes


ROWS_PER_CUTOFF = 8.0
"""Number of rows used in a fit per period of the effort cut-off.

More rows per period add no information.
"""


@dataclass(eq=False)
class TrainingData:
    """Prepared training data, with the quantities that are computed from the data only one time.

    Attributes:
        data: Prepared dataset.
        settings: Filter settings of the dataset.
        Y: (N, n, b) base regressor.
        load: (N, n) torque of the payloads [N·m].
        target: (N, n) filtered torque without the payloads [N·m].
        steps: (N, n) joint displacements since the previous sample [rad].
        fold: (N,) index of the cross-validation fold of every row.
        whole: Whether the folds consist of whole trajectories.
        kept: (N,) mask of the rows that are used in the fit.
    """

    data: Dataset
    settings: FilterSettings
    Y: FloatArray
    load: FloatArray
    target: FloatArray
    steps: FloatArray
    fold: IntArray
    whole: bool
    kept: BoolArray

    @staticmethod
    def of(
        data: Dataset,
        settings: FilterSettings,
        robot: RobotModel,
        base: BaseParameters,
        scale: FloatArray,
    ) -> TrainingData:
        """Return the training data from a prepared dataset.

        Args:
            data: Prepared dataset.
            settings: Filter settings of the dataset.
            robot: Robot model.
            base: Base parameters of the robot.
            scale: (n,) torque per unit of effort.
        """
        motion = tuple(data[name] for name in MOTION)
        load = payload_torque(robot, data, *motion)
        Y = base.regressor(robot, *motion).reshape(*load.shape, base.rank)
        fold, whole = folds_of(data)
        target = data["effort_f"] * scale - load
        kept = rows_kept(data, settings) & rows_to_fit(data)
        return TrainingData(data, settings, Y, load, target, path_steps(data), fold, whole, kept)

    def observed(
        self, groups: Mapping[str, Columns], rigid: FloatArray | None, shapes: Shapes
    ) -> Observed:
        """Return the compressed observations with the columns of the passed groups.

        Args:
            groups: Functions that compute columns, by group name.
            rigid: (b,) base parameters for the torque through the gears; None if only the payloads
                count.
            shapes: Nonlinear friction parameters.
        """
        slices: dict[str, slice] = {}
        blocks = self._blocks(groups, self.transmitted(rigid), shapes, slices)
        return observe(blocks, slices, self.Y.shape[2])

    def transmitted(self, rigid: FloatArray | None) -> FloatArray:
        """Return (N, n) the torque through the gears [N·m]."""
        return self.load if rigid is None else self.Y @ rigid + self.load

    def load_share(self, rigid: FloatArray) -> FloatArray:
        """Return (n,) the RMS ratio of the gear torque to the torque beyond the rigid body."""
        Y, target, load = self.Y[self.kept], self.target[self.kept], self.load[self.kept]
        transmitted = np.mean((Y @ rigid + load) ** 2, axis=0)
        left = np.mean((target - Y @ rigid) ** 2, axis=0)
        return np.asarray(np.sqrt(transmitted / np.maximum(left, 1e-300)))

    def rest(self, rigid: FloatArray, shapes: Shapes) -> list[Part]:
        """Return the motion, the torque left by the rigid body, and the filter of each series."""
        parts = []
        transmitted = self.transmitted(rigid)
        for condition, rows, motion in motions(self.data, self.steps, transmitted, shapes):
            kept = self.kept[rows]
            left = (self.target[rows] - self.Y[rows] @ rigid)[kept]
            parts.append((motion, left, self._through(condition, rows)))
        return parts

    def _blocks(
        self,
        groups: Mapping[str, Columns],
        transmitted: FloatArray,
        shapes: Shapes,
        slices: dict[str, slice],
    ) -> Iterator[Block]:
        """Yield columns, regressor and target of each series; set the column ranges in `slices`."""
        for condition, rows, motion in motions(self.data, self.steps, transmitted, shapes):
            made = {name: columns(motion) for name, columns in groups.items()}
            start = 0
            for name, columns in made.items():
                slices[name] = slice(start, start + len(columns))
                start += len(columns)
            F = np.stack([column for columns in made.values() for column in columns], axis=2)
            F, kept = self._through(condition, rows)(F), self.kept[rows]
            fold, Y, target = self.fold[rows][kept], self.Y[rows][kept], self.target[rows][kept]
            for one in np.unique(fold):
                own = fold == one
                yield int(one), F[own], Y[own], target[own]

    def _through(self, condition: Conditions, rows: slice) -> Through:
        """Return a function that filters the effort of a series and selects the rows of the fit."""
        t, kept = self.data["t"][rows], self.kept[rows]
        return lambda values: smoothed(values, condition, t, self.settings)[kept]


def rows_kept(data: Dataset, settings: FilterSettings) -> BoolArray:
    """Return (N,) a mask of the rows that a fit uses.

    If the filter settings do not define down-sampling, the number of rows follows from the effort
    cut-off.
    """
    if settings.downsamples:
        return downsampling_mask(data, settings)
    out = np.zeros(len(data), dtype=bool)
    for _, rows in data.slices():
        out[rows][:: _stride(data["t"][rows], settings)] = True
    return out


def _stride(t: FloatArray, settings: FilterSettings) -> int:
    if len(t) < 2:
        return 1
    rate = (len(t) - 1) / (t[-1] - t[0])
    cutoff = settings.effort * (0.5 * rate if settings.unit == "nyquist" else 1.0)
    return max(1, int(rate / (ROWS_PER_CUTOFF * cutoff)))
