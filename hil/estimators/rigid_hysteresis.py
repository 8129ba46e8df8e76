"""Rigid-body dynamics with friction that remembers, depends on load, and is chosen by the data.

What classical friction models lack is memory: a joint that turns round, or stands still, has the
friction its last millirad left it with. Dahl's states carried along the measured path take the
place of sign(v); friction grows with the torque through the gear; gears and motors ripple.

A fit goes in four steps (`RigidHysteresis._learn`):

1. The rigid body with the core of friction; the torque through every gear follows.
2. The shapes of each joint's friction (lengths, Stribeck speeds, exponents) by variable projection.
3. The columns of the friction library beside the rigid body, compressed per trajectory. Which
   groups of columns a joint gets, and how firmly they are held, is decided by leaving trajectories
   out.
4. All coefficients at once, then the links of a robot that can exist.
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
"""Samples per joint for its friction, beside those for the links."""


def _group_names(name: str, value: str | Sequence[str]) -> str | tuple[str, ...]:
    """`auto`, or names of groups; the core is always there and need not be named.

    Raises:
        SpecError: There is no such group.
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
                f"{name}: there is no group {group!r}",
                hint=did_you_mean(str(group), words) or f"there are {', '.join(words)}",
            )
    return tuple(dict.fromkeys((CORE, *chosen)))


class RigidHysteresis(RobotEstimator):
    """The default for dynamics: a robot that can exist, with friction that remembers.

    Attributes:
        rigid_: (b,) base parameters.
        inertial_: (11n,) of a robot that can exist; absent without `consistent`.
        law_: Friction, ripple and drive.
        filters_: Those that were used.
        gear_rigid_: (b,) base parameters the torque through the gears was computed with.
        held_out_: (n,) error on left-out trajectories, filtered, in effort units; the same
            trajectories chose the groups.
        parameter_names_: Base parameters, then every joint's friction.
    """

    estimator: ClassVar[str] = "rigid-hysteresis"
    series_kinds: ClassVar[tuple[tuple[SeriesKind, ...], ...]] = (("trajectory",), ("move",))

    friction: str | tuple[str, ...] = parameter(
        "auto",
        _group_names,
        doc="`auto` lets training trajectories that are left out choose among a few nested lists "
        "of groups, joint by joint; or the groups every joint has.",
    )
    fit_shapes: bool = parameter(
        True,
        flag,
        doc="Fit lengths, Stribeck speeds and exponents; False keeps the usual ones.",
    )
    consistent: bool = parameter(
        True, flag, doc="Links that can exist; needs the extra `identify`."
    )
    gear_ratio: float | None = parameter(
        None,
        number,
        above=0,
        optional=True,
        doc="Motor turns per joint turn, for ripple; by default the arm's, if known.",
    )
    filters: FilterSettings | None = parameter(
        None,
        settings,
        FilterSettings,
        optional=True,
        doc="Preprocessing of training and prediction alike; by default 11 Hz for motion and "
        "17.6 Hz for effort, whatever the sample rate, and more for arms that move quicker.",
    )

    inertial_: FloatArray

    def extras(self) -> dict[str, str]:
        """A solver of semidefinite programs, if the links are to be such that can exist."""
        purpose = f"{IDENTIFY['identify']}; consistent: false does without"
        return {"identify": purpose} if self.consistent else {}

    def needs(self, robot: RobotModel, *, loaded: bool = False) -> Needs:
        """Return what a fit cannot do without: samples for links and friction, and drive gains."""
        rank = base_parameters(robot, rotor=True).rank
        return Needs({"samples": rank + FRICTION_SAMPLES * robot.n}, gains=True)

    def fit(self, dataset: Dataset, robot: RobotModel) -> Self:
        """Fit to every series given; declared loads are part of what the gears transmit.

        Raises:
            FitError: The data are too few, not finite, of another robot or unit, hold efforts
                that cannot be, or do not excite all parameters.
            DataError: A series cannot be filtered.
            PluginError: The extra `identify` is missing.
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
        """Fit to prepared data in the four steps of the module; sets what was fitted."""
        robot, base, turns = self.robot_, self._base, motor_turns(self.robot_, self.gear_ratio)
        training = TrainingData.of(data, self.filters_, robot, base, self.torque_scale_)
        ripple = bool(np.any(np.isfinite(turns)))
        library = groups(ripple=ripple, temperature=temperatures_vary(data))
        shapes = first_shapes(turns)

        def rigid_with(names: Sequence[str], gear: FloatArray | None) -> FloatArray:
            """(b,) with these groups beside the core in every joint."""
            chosen = {name: library[name] for name in (CORE, *names)}
            observed = training.observed(chosen, gear, shapes)
            return solve(observed, [tuple(chosen)] * observed.joints).rigid

        # Steps 1 and 2: the torque through the gears is one of what the backbone is made of, so
        # that the rigid body is fitted again once it is known, and again with other shapes.
        gear_rigid = rigid_with(BACKBONE, rigid_with(["speed p"], None))
        if self.fit_shapes:
            shapes = fitted_shapes(training.rest(gear_rigid, shapes), shapes)
            gear_rigid = rigid_with(BACKBONE, gear_rigid)
        # Step 3. Parts of one trajectory are no trajectories: there, richer must be better.
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
        """Effort per row: `gravity`, `inertia`, `friction`, `ripple`, `drive`, `payload`.

        Friction is filtered like the motion it follows from.

        Raises:
            DataError: The data are of another robot or unit, or cannot be filtered.
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
        """A predictor for one sample at a time that carries the friction states with it.

        It filters nothing: give it motion as smooth as the training's.
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
        """Return the friction (n,) that an unloaded joint at rest holds before it slides [N·m]."""
        return self.law_.break_away()

    def _rigid_torques(
        self, data: Dataset, load: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rigid body, its gravity, and the torque through the gears, each (N, n) [N·m]."""
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
        """Rigid body, friction and its shapes, gains and deviations."""
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
        """Names of all parameters, and which groups every joint has."""
        return super().fitted_facts() | {
            "parameter_names": list(self.parameter_names_),
            "friction": [list(names) for names in self.law_.chosen],
            "filters": self.filters_.model_dump(),
        }

    def restore(self, arrays: dict[str, FloatArray], facts: dict[str, Any]) -> None:
        """Take over what `fitted_arrays` and `fitted_facts` wrote."""
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
"""Lowest cut-off for velocity and acceleration, and that of the effort over it. An arm's motion has
the same frequencies however often it is sampled. A fit learns from a wider band than it predicts:
ripple shows there. Chosen on four UR10e trajectories, each left out in turn."""

BANDWIDTHS = 5.0
"""A cut-off is at least so many times the bandwidth of the motion, for arms that are quicker."""

ENERGY = 0.999
"""Share of the velocity's energy within its bandwidth."""

MOST_OF_NYQUIST = 0.75


def filters_for(dataset: Dataset) -> FilterSettings:
    """Filters by the bandwidth of the motion that is learnt from.

    Raises:
        DataError: Time does not increase.
    """
    bandwidth, nyquist = 0.0, np.inf
    for condition, rows in dataset.slices():
        if condition.kind not in AT_REST and rows.stop - rows.start > 2:
            t = dataset["t"][rows]
            nyquist = min(nyquist, 0.5 * sample_rate(t))
            # Measured velocity says it best: differences of positions are mostly noise.
            measured = dataset["qd"][rows] if "qd" in dataset.columns else None
            velocity = derivative(dataset["q"][rows], t) if measured is None else measured
            bandwidth = max(bandwidth, _bandwidth(velocity, t))
    most = MOST_OF_NYQUIST * nyquist / EFFORT_RATIO
    motion = round(float(min(max(MOTION_HZ, BANDWIDTHS * bandwidth), most)), 2)
    effort = round(EFFORT_RATIO * motion, 2)
    return FilterSettings(unit="hz", velocity=motion, acceleration=motion, effort=effort)


def _bandwidth(velocity: FloatArray, t: FloatArray) -> float:
    """Frequency below which nearly all of the median joint's velocity (N, n) lies [Hz]."""
    from scipy.signal import welch

    rate = sample_rate(t)
    length = min(len(t), int(4.0 * rate))
    if length < 2:
        raise DataError(
            f"samples at {rate:.3g} Hz are too slow to tell how quick a motion is",
            hint="look at the unit of the time stamps: they have to be seconds",
        )
    frequency, power = welch(velocity, rate, nperseg=length, axis=0)
    share = np.cumsum(power, axis=0) / np.maximum(np.sum(power, axis=0), 1e-300)
    return float(np.median(frequency[np.argmax(share >= ENERGY, axis=0)]))


def motor_turns(robot: RobotModel, gear_ratio: float | None) -> FloatArray:
    """(n,) motor turns per joint turn; NaN where nobody knows."""
    if gear_ratio is not None:
        return np.full(robot.n, gear_ratio)
    if robot.arm is None:
        return np.full(robot.n, np.nan)
    return np.asarray(robot.arm.gear_ratio, dtype=np.float64)


NO_TRAJECTORIES = (
    "one trajectory only: friction columns were chosen on parts of it left out, which is less "
    "than a trajectory of its own"
)

WORSE = 1.2
"""Growth of a joint's error by bounds on links that a note reports."""

BACKBONE = ("load", "stribeck", "speed p")
"""Friction while shapes are looked for."""


def _offered(
    training: TrainingData,
    library: Mapping[str, Columns],
    friction: str | Sequence[str],
    gear_rigid: FloatArray,
) -> tuple[dict[str, Columns], list[list[tuple[str, ...]]]]:
    """Groups that are computed, and the lists every joint may choose from."""
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
    """What people should know about the choice of groups."""
    notes = [] if training.whole else [NO_TRAJECTORIES]
    missing = [] if friction == "auto" else [name for name in friction if name not in library]
    if missing:
        left_out = ", ".join(missing)
        notes.append(f"without motor turns or varying temperatures left out: {left_out}")
    return tuple(notes)


def _require_excited(solved: Solved, base: BaseParameters) -> None:
    weighted = solved.weighted
    X, _ = weighted.weighted_system()
    names = (*base.names, *(f"friction {i}" for i in range(X.shape[1] - base.rank)))
    require_rank(weighted.rank, weighted.condition, names, X, highest=1e8)


def _bound_notes(
    bounds: InertialBounds, solved: Solved, joint_names: tuple[str, ...]
) -> tuple[str, ...]:
    """Notes on links at their bounds, and on what the bounds cost."""
    assert solved.inertial is not None
    notes = bounds.notes + bounds.reached(solved.inertial, joint_names)
    worst = float(np.max(solved.grown))
    if worst > WORSE:
        joint = joint_names[int(np.argmax(solved.grown))]
        notes += (
            f"links that can exist make the error of {joint} {worst:.2g} times larger: if the "
            "load and the robot's nominal model are right, try consistent: false",
        )
    return notes


ROWS_PER_CUTOFF = 8.0
"""A fit keeps so many rows per period of the effort's cut-off: more say nothing new."""


@dataclass(eq=False)
class TrainingData:
    """Prepared data and all that is computed from them once.

    Attributes:
        data: Prepared dataset.
        settings: Its filters.
        Y: (N, n, b) base regressor.
        load: (N, n) torque of declared loads [N·m].
        target: (N, n) filtered torque without them [N·m].
        steps: (N, n) path [rad].
        fold: (N,) fold of every row.
        whole: Whether folds are whole trajectories.
        kept: (N,) rows that are fitted.
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
        """From prepared data of a robot whose efforts make `scale` (n,) torque per unit."""
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
        """Compressed observations with these groups' columns.

        Args:
            groups: By name.
            rigid: (b,) base parameters for the torque through the gears; None for loads alone.
            shapes: Of the friction.
        """
        slices: dict[str, slice] = {}
        blocks = self._blocks(groups, self.transmitted(rigid), shapes, slices)
        return observe(blocks, slices, self.Y.shape[2])

    def transmitted(self, rigid: FloatArray | None) -> FloatArray:
        """(N, n) torque through the gears [N·m]."""
        return self.load if rigid is None else self.Y @ rigid + self.load

    def load_share(self, rigid: FloatArray) -> FloatArray:
        """(n,) torque through each gear over what the rigid body leaves, on kept rows, RMS."""
        Y, target, load = self.Y[self.kept], self.target[self.kept], self.load[self.kept]
        transmitted = np.mean((Y @ rigid + load) ** 2, axis=0)
        left = np.mean((target - Y @ rigid) ** 2, axis=0)
        return np.asarray(np.sqrt(transmitted / np.maximum(left, 1e-300)))

    def rest(self, rigid: FloatArray, shapes: Shapes) -> list[Part]:
        """Per series its motion, what the rigid body leaves on kept rows, and its filter."""
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
        """Columns, regressor and target series by series; sets the columns' `slices`."""
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
        """The effort's filter over one series, and the rows that are kept of it."""
        t, kept = self.data["t"][rows], self.kept[rows]
        return lambda values: smoothed(values, condition, t, self.settings)[kept]


def rows_kept(data: Dataset, settings: FilterSettings) -> BoolArray:
    """(N,) which rows a fit uses: what the settings say, else enough for the effort's cut-off."""
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
