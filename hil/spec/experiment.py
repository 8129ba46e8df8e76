"""Model of an experiment YAML file: typed, immutable, without unknown keys, with units in the keys.

The models are in the order of the file: excitation (`Dwell`, `Fourier`, `Optimise`), loads at the
flange (`Load`, `Weigh`), evaluation of models (`Validate`, `Accept`), and the complete spec
(`ExperimentSpec`). The function `spec_hash` identifies a spec by a hash of its content, independent
of its formatting.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializeAsAny,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)

from hil.arms import Payload
from hil.core import PluginError, SpecError, plugins
from hil.spec.field_types import (
    IS_NUMBER,
    Count,
    Finite,
    FormatVersion,
    JointRange,
    Name,
    NonNegative,
    Positive,
    Seed,
    Strict,
    mistake,
)
from hil.spec.interlocks import (
    DEFAULTS,
    Interlocks,
    SpeedInterlock,
    SpeedScalingInterlock,
    lowest,
)

FEWEST = 3
"""Minimum number of trajectories for the evaluation of models with loads."""


class WarmUp(Strict):
    """Motion before measuring, so that the joint friction reaches its warm value."""

    duration_s: Annotated[float, Field(ge=0, le=14_400), IS_NUMBER] = Field(
        60.0, description="Duration of the warm-up; 0 disables it."
    )


class Reference(Strict):
    """Reference pose that is measured repeatedly during a run to detect drift."""

    every: Count = Field(
        50,
        description="Number of poses or trajectories between two visits to the reference poses; 0 "
        "disables these visits.",
    )
    q_deg: tuple[Finite, ...] | None = Field(
        None,
        description="Reference pose; by default the first pose of a dwell program, or the pose "
        "with the most free space of a Fourier program.",
    )


class Record(Strict):
    """Settings of the recording."""

    rate_hz: Positive | None = Field(
        None,
        description="Rate at which states are recorded; only the robot's rate is possible, which "
        "is the default.",
    )
    rotate_mb: Annotated[float, Field(ge=1, allow_inf_nan=False), IS_NUMBER] = Field(
        1024.0, description="File size above which the recording continues in a new file."
    )


class Fit(BaseModel):
    """Estimator to fit; the keys beside `estimator` are parameters of the estimator."""

    model_config = ConfigDict(frozen=True, extra="allow")

    estimator: str = Field(
        description="Name of an estimator (entry point in `hil.estimators`), e.g. `static-wls`."
    )

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the estimator, as written in the file."""
        return dict(self.model_extra or {})


class StudyEntry(BaseModel):
    """Study of the whole run; the keys beside `study` are parameters of the study."""

    model_config = ConfigDict(frozen=True, extra="allow")

    study: str = Field(
        description="Name of a study (entry point in `hil.studies`), e.g. `static-separation`."
    )

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the study, as written in the file."""
        return dict(self.model_extra or {})


class Dwell(Strict):
    """Dwell program: move to many poses and measure at standstill."""

    kind: Literal["dwell"] = Field(description="Selects the dwell program.")
    waypoints: Annotated[int, Field(ge=1, le=100_000), IS_NUMBER] = Field(
        650, description="Number of poses, distributed over the joint ranges."
    )
    file: str | None = Field(
        None,
        description="CSV file with one pose per row and one column per joint. An optional first "
        "line names the joints (or `q1` to `q6`): all names end in `_deg`, or all in `_rad`, or "
        "none of them has a unit. A relative path starts at the folder of the spec. With a file, "
        "`waypoints` has no effect.",
    )
    file_unit: Literal["deg", "rad"] = Field(
        "deg",
        description="Unit of the poses in `file`; not required if the first line of the file "
        "states it. If neither states it and no angle exceeds 2π, the file is refused.",
    )
    dwell_s: Annotated[float, Field(ge=0.01, le=600), IS_NUMBER] = Field(
        0.095, description="Minimum time at standstill in each pose."
    )
    samples_per_dwell: Annotated[int, Field(ge=2, le=10_000), IS_NUMBER] = Field(
        10, description="Number of settled samples recorded in each pose."
    )
    settle_rad_s: Positive = Field(
        0.002,
        description="Joint speed below which the arm counts as settled; every joint must be "
        "slower.",
    )
    settle_timeout_s: Annotated[float, Field(gt=0, le=600), IS_NUMBER] = Field(
        3.0,
        description="Maximum settling time; then the pose is marked as not settled, and the "
        "program continues.",
    )
    seed: Seed = Field(7, description="Seed for the random poses and their order.")
    max_velocity_deg_s: Positive = Field(60.0, description="Maximum speed of every joint.")
    max_acceleration_deg_s2: Positive = Field(
        80.0, description="Maximum acceleration of every joint."
    )
    max_jerk_deg_s3: Positive = Field(800.0, description="Maximum jerk of every joint.")
    approach: Literal["both", "positive", "negative", "free"] = Field(
        "both",
        description="Approach direction of every joint: `positive` arrives from below, "
        "`negative` from above, and `both` dwells in every pose twice, once per direction. "
        "`free` adds no approach motion, so the direction depends on the path.",
    )
    approach_deg: Positive = Field(
        3.0, description="Angle that every joint moves in the approach motion to a pose."
    )
    range_deg: tuple[JointRange, ...] | None = Field(
        None,
        description="Joint ranges from which the poses are drawn, one pair per joint; by default "
        "the ranges of the arm.",
    )

    @property
    def stated_unit(self) -> Literal["deg", "rad"] | None:
        """Unit of the poses in `file`; None if the spec does not contain the unit."""
        return self.file_unit if "file_unit" in self.model_fields_set else None


class Optimise(Strict):
    """Optimised trajectories, each of which complements the previous ones.

    `optimise: true` is the same as `optimise: {}`; with `false` or `null`, trajectories are random.
    """

    objective: Literal["log_det", "condition"] = Field(
        "log_det",
        description="Quantity to optimise: `log_det` minimises the errors of the parameters "
        "(D-optimal). `condition` minimises the condition number of the base regressor, which "
        "states how evenly, but not how accurately, the parameters are determined.",
    )
    scaled: bool = Field(
        True,
        description="With `objective: condition`: `true` scales every column of the regressor to "
        "length 1; `false` uses the columns in their mixed units.",
    )
    friction: bool = Field(
        False,
        description="Whether the trajectories must also determine Coulomb, viscous and offset "
        "friction of each joint.",
    )
    rotor: bool = Field(
        True,
        description="Whether the trajectories must also determine the rotor inertia of each "
        "joint, in addition to the inertia of the links.",
    )
    starts: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        3, description="Number of random starts per trajectory; the best result is used."
    )
    budget_s: Annotated[float, Field(gt=0, le=86_400), IS_NUMBER] = Field(
        120.0,
        description="Maximum processor time per trajectory; if the time is reached, the result "
        "depends on the computer.",
    )
    torque_percent: Annotated[float, Field(gt=0, le=100), IS_NUMBER] = Field(
        80.0,
        description="Share of the arm's torque limits that the nominal rigid body with its "
        "heaviest load may use; the rest is reserved for friction and control.",
    )
    max_jerk_deg_s3: Positive | None = Field(
        None, description="Maximum jerk within a trajectory; by default no limit."
    )
    clearance_mm: NonNegative | None = Field(
        None,
        description="Minimum distance to the table, the walls and the arm itself; at least the "
        "station's `clearance_m`, which is the default.",
    )
    seed: Seed | None = Field(
        None, description="Seed for the random starts; by default `excitation.seed`."
    )


def _written_short(value: Any) -> Any:
    return {True: {}, False: None}[value] if isinstance(value, bool) else value


OptionalOptimise = Annotated[
    Optimise | None,
    BeforeValidator(_written_short, json_schema_input_type=Optimise | bool | None),
]

LONGEST_TRAJECTORY_S = 3600.0
"""Maximum duration of a trajectory [s]; all set-points of a trajectory are in memory at the same
time."""


class Fourier(Strict):
    """Finite Fourier series per joint (eq. 29, network paper), at standstill at both ends."""

    kind: Literal["fourier"] = Field(description="Selects Fourier trajectories.")
    harmonics: Annotated[int, Field(ge=2, le=50), IS_NUMBER] = Field(
        5, description="Order of the series: number of sines and number of cosines per joint."
    )
    fundamental_hz: Annotated[float, Field(ge=0.001, le=10), IS_NUMBER] = Field(
        0.1, description="Frequency of the first harmonic; its inverse is the period."
    )
    periods: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        1, description="Number of periods per trajectory, without a break."
    )
    trajectories: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        12, description="Number of different trajectories, each from standstill to standstill."
    )
    seed: Seed = Field(7, description="Seed for the random trajectories.")
    max_velocity_deg_s: Positive = Field(100.0, description="Maximum speed of every joint.")
    max_acceleration_deg_s2: Positive = Field(
        300.0, description="Maximum acceleration of every joint."
    )
    max_jerk_deg_s3: Positive = Field(
        2000.0,
        description="Maximum jerk of the moves between trajectories; trajectories themselves "
        "have no jerk limit.",
    )
    amplitude_deg: Positive = Field(
        90.0,
        description="Largest excursion of random trajectories from their centre; optimised "
        "trajectories are limited only by `range_deg`.",
    )
    range_deg: tuple[JointRange, ...] | None = Field(
        None,
        description="Joint ranges in which the trajectories stay, one pair per joint; by default "
        "the ranges of the arm.",
    )
    optimise: OptionalOptimise = Field(
        None,
        description="Settings of the optimisation of the trajectories; `true` selects the "
        "default settings. Without optimisation, each trajectory is the best of a few random "
        "draws.",
    )

    @model_validator(mode="after")
    def _a_trajectory_ends(self) -> Fourier:
        lasts = self.periods / self.fundamental_hz
        if lasts > LONGEST_TRAJECTORY_S:
            message = (
                f"a trajectory of {self.periods} periods of {1 / self.fundamental_hz:g} s lasts "
                f"{lasts:g} s, longer than {LONGEST_TRAJECTORY_S:g} s: use more trajectories"
            )
            raise mistake(message, "periods")
        return self

    @model_validator(mode="after")
    def _amplitudes_are_of_random_draws(self) -> Fourier:
        if self.optimise is not None and "amplitude_deg" in self.model_fields_set:
            raise mistake(
                "has no effect on optimised trajectories: give range_deg instead", "amplitude_deg"
            )
        return self


BUILT_IN_EXCITATIONS = ("dwell", "fourier")


def _plugged_excitation(value: Any, validate: ValidatorFunctionWrapHandler) -> Any:
    """Validate the section of a plug-in excitation with the model `Spec` of the plug-in.

    Raises:
        ValueError: The plug-in cannot be loaded, or has no model `Spec`.
    """
    kind = value.get("kind") if isinstance(value, dict) else None
    if kind in BUILT_IN_EXCITATIONS or kind not in plugins.names("hil.excitations"):
        return validate(value)
    try:
        model = getattr(plugins.load("hil.excitations", kind), "Spec", None)
    except PluginError as error:
        raise ValueError(f"{error.message} → {error.hint}") from None
    if not (isinstance(model, type) and issubclass(model, Dwell | Fourier)):
        raise ValueError(
            f"the excitation '{kind}' has no `Spec` that derives from hil.spec.Dwell or Fourier"
        )
    return model.model_validate(value)


Excitation = Annotated[
    Dwell | Fourier,
    Field(discriminator="kind"),
    WrapValidator(_plugged_excitation),
    SerializeAsAny(),
]

# A length above ten metres is probably in the wrong unit; no flange carries such a load.
Lever = Annotated[float, Field(ge=-10, le=10), IS_NUMBER]

Extent = Annotated[float, Field(gt=0, le=10), IS_NUMBER]


class Load(Strict):
    """Body mounted at the flange for one pass of the excitation."""

    mass_kg: NonNegative = Field(0.0, description="Mass of the load; 0 for the bare flange.")
    com_m: tuple[Lever, Lever, Lever] = Field(
        (0.0, 0.0, 0.0), description="Centre of mass in the flange frame."
    )
    inertia_kgm2: tuple[Finite, Finite, Finite, Finite, Finite, Finite] = Field(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        description="Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass, in flange axes.",
    )
    size_m: tuple[Extent, Extent] | None = Field(
        None,
        description="Length and radius of the payload's body along the flange axis, for "
        "collision checks; by default, a body is estimated from the mass.",
    )
    prompt: str = Field(
        "", description="Instruction that the operator reads before the measurement with this load."
    )

    def payload(self) -> Payload:
        """Return the load as a payload for robots and estimators."""
        return Payload(self.mass_kg, self.com_m, self.inertia_kgm2)

    @model_validator(mode="after")
    def _inertia_belongs_to_a_body(self) -> Load:
        if not _is_inertia_of_a_body(self.inertia_kgm2):
            raise mistake(
                "no body has this inertia: each principal moment must be ≥ 0 and at most the sum "
                "of the other two (the order is Ixx, Iyy, Izz, Ixy, Ixz, Iyz)",
                "inertia_kgm2",
            )
        return self


def _is_inertia_of_a_body(inertia: tuple[float, ...]) -> bool:
    """Return whether a rigid body can have the inertia matrix I.

    The second moments of mass tr(I)/2·1 − I must be positive semidefinite, which is equivalent to
    the triangle inequality of the principal moments (Traversaro et al., 'Identification of fully
    physical consistent inertial parameters', IROS 2016).
    """
    xx, yy, zz, xy, xz, yz = inertia
    half = (xx + yy + zz) / 2
    a, b, c, d, e, f = half - xx, half - yy, half - zz, -xy, -xz, -yz
    minors = (a, b, c, a * b - d * d, a * c - e * e, b * c - f * f)
    determinant = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e)
    slack = 1e-9 * max(abs(half), 1e-300)
    sizes = (1, 1, 1, half, half, half, half * half)
    return all(
        m >= -slack * abs(size) for m, size in zip((*minors, determinant), sizes, strict=True)
    )


class Weigh(Strict):
    """Payload check of each load against the first load; `weigh: false` switches it off.

    The default tolerances were determined by measurements: docs/explanation/weighing.md.
    """

    poses: Annotated[int, Field(ge=0, le=10), IS_NUMBER] = Field(
        2,
        description="Number of poses of the payload check, each approached from both sides; 0 "
        "disables the check.",
    )
    tolerance_kg: Positive = Field(
        0.15, description="Allowed difference between declared and identified mass, for any load."
    )
    tolerance_percent: NonNegative = Field(
        10.0,
        description="Additional allowed mass difference, as a share of the difference between "
        "the masses of the load and of the first load.",
    )
    tolerance_com_m: Positive = Field(
        0.03, description="Allowed distance between declared and identified centre of mass."
    )


def _off(value: Any) -> Any:
    return None if value is False else value


OptionalWeigh = Annotated[
    Weigh | None, BeforeValidator(_off, json_schema_input_type=Weigh | Literal[False] | None)
]
"""Settings of the payload check; `weigh: false` and `weigh: null` both switch the check off."""


class HoldOut(Strict):
    """Hold-out set for the evaluation of models, always whole poses, trajectories or loads."""

    trajectories: Count | None = Field(
        None,
        description="Number of trajectories that are held out, from the end of the program; by "
        "default a quarter of all trajectories and at least one, or none if `loads` is given.",
    )
    trajectories_percent: Annotated[float, Field(ge=0, le=90), IS_NUMBER] | None = Field(
        None,
        description="Share of the trajectories that is held out, drawn with `seed`, as an "
        "alternative to `trajectories`; at least one trajectory is held out and at least one is "
        "fitted, with every load.",
    )
    poses_percent: Annotated[float, Field(ge=0, le=90), IS_NUMBER] | None = Field(
        None,
        description="Share of the poses that is held out, drawn with `seed`, always both "
        "approaches of a pose; by default 20, or none if `loads` is given.",
    )
    loads: tuple[Count, ...] = Field(
        (),
        description="Loads that are held out, as indices into `loads` from 0. Together with "
        "`trajectories`, `trajectories_percent` or `poses_percent`, the models are evaluated on "
        "motions *and* loads that no fit has used.",
    )
    seed: Seed = Field(7, description="Seed for the random poses or trajectories.")

    @model_validator(mode="after")
    def _trajectories_are_chosen_one_way(self) -> HoldOut:
        if self.trajectories is not None and self.trajectories_percent is not None:
            raise mistake(
                "excludes `trajectories`, which selects the last ones: remove one of the two keys",
                "trajectories_percent",
            )
        return self

    def trajectories_of(self, total: int) -> int:
        """Return the number of held-out trajectories out of `total` different trajectories."""
        if self.trajectories is not None:
            return self.trajectories
        if self.trajectories_percent is not None:
            count = round(self.trajectories_percent / 100 * total)
            return max(1, min(count, total - 1)) if self.trajectories_percent else 0
        return 0 if self.loads else max(1, total // 4)

    def poses_of(self, total: int) -> int:
        """Return the number of held-out poses out of `total` different poses."""
        default = 0.0 if self.loads else 20.0
        percent = default if self.poses_percent is None else self.poses_percent
        return max(1, round(percent / 100 * total)) if percent else 0


class Validate(Strict):
    """Settings for the evaluation of the fitted models."""

    hold_out: HoldOut = Field(HoldOut(), description="Hold-out set, which no estimator uses.")
    under_loads: bool = Field(
        False,
        description="Fit to the first load only, and evaluate every model with the other loads "
        "as well: without knowledge of the load, with the declared load, and with the identified "
        "load. Declared loads are checked.",
    )


class RmseLimit(Strict):
    """Maximum root-mean-square error (RMSE) on the hold-out set."""

    max: Positive = Field(description="Maximum error, in `unit`.")
    unit: Literal["A", "N·m", "Nm"] = Field(
        description="Unit of the effort that the robot measures."
    )
    per: Literal["joint", "mean"] = Field(
        "mean",
        description="Whether the limit applies to every joint, or to the mean of the joints.",
    )
    signal: Literal["raw", "filtered"] = Field(
        "raw",
        description="Measured effort that the model is compared with: as measured, or low-pass "
        "filtered.",
    )


class NrmseLimit(Strict):
    """Maximum ratio of RMSE to the standard deviation of the signal."""

    max: Positive = Field(description="Maximum ratio, without unit (0.1 is 10 %).")
    per: Literal["joint", "mean"] = Field(
        "mean",
        description="Whether the limit applies to every joint, or to the mean of the joints.",
    )


class GapsLimit(Strict):
    """Maximum share of missing samples."""

    max: NonNegative = Field(description="Maximum share, in percent of the expected samples.")


class LoadErrorLimit(Strict):
    """Maximum ratio of the error with a load to the error with the first load.

    The field `told` sets what the model knows about the load.
    """

    max: Positive = Field(
        description="Maximum ratio, without unit; both errors are means of the joints."
    )
    told: Literal["declared", "calibrated"] = Field(
        "declared",
        description="Data that the model uses: the declared load (`declared`), or the declared "
        "load and drive gains calibrated with the other loads (`calibrated`).",
    )
    of: Literal["every", "first"] = Field(
        "every",
        description="Whether the limit applies to every estimator, or only to the first "
        "estimator of `fit`; the others are then reported for comparison.",
    )


class ContradictedLimit(Strict):
    """Maximum number of declared loads that the identified loads contradict."""

    max: Count = Field(description="Maximum number; a load that cannot be identified is counted.")


class Accept(Strict):
    """Acceptance criteria; without model criteria, the verdict is `not judged` or `rejected`."""

    rmse: RmseLimit | None = Field(
        None, description="Error on the hold-out set, in the unit of the robot."
    )
    nrmse: NrmseLimit | None = Field(None, description="Error on the hold-out set, without unit.")
    gaps_percent: GapsLimit | None = Field(
        None, description="Limit of the samples that are missing in the recording."
    )
    load_error_ratio: LoadErrorLimit | None = Field(
        None, description="Error with any other load; requires `validate.under_loads`."
    )
    contradicted_loads: ContradictedLimit | None = Field(
        None,
        description="Limit of the declared loads that the first estimator contradicts; requires "
        "`validate.under_loads`.",
    )

    @property
    def under_loads(self) -> tuple[str, ...]:
        """Keys of the acceptance criteria about loads."""
        keys = ("load_error_ratio", "contradicted_loads")
        return tuple(key for key in keys if getattr(self, key) is not None)


class ExperimentSpec(Strict):
    """Complete experiment, from excitation to acceptance."""

    hil: FormatVersion = Field(description="Version of the spec format.")
    name: Name = Field(description="Name of the run directories; letters, digits, `_`, `.`, `-`.")
    description: str = Field("", description="Purpose of the experiment; shown in the report.")
    robot: str = Field(description="Name of a robot of the station.")
    excitation: Excitation = Field(description="Motion of the arm during the measurement.")
    loads: tuple[Load, ...] = Field(
        (Load(),),
        min_length=1,
        description="Loads; the excitation is executed once with each load.",
    )
    weigh: OptionalWeigh = Field(
        Weigh(), description="Payload check of the loads; `false` or `null` disables it."
    )
    warm_up: WarmUp = Field(WarmUp(), description="Motion before the measurement.")
    reference: Reference = Field(Reference(), description="Pose that is measured repeatedly.")
    record: Record = Field(Record(), description="Settings of the recording.")
    interlocks: Interlocks = Field(
        DEFAULTS,
        description="Conditions that stop or pause the motion; default interlocks of kinds that "
        "are not listed here remain active.",
    )
    fit: tuple[Fit, ...] = Field((), description="Estimators to fit, all to the same data.")
    validation: Validate = Field(
        Validate(), alias="validate", description="Evaluation of the fitted models."
    )
    accept: Accept = Field(Accept(), description="Acceptance criteria.")
    study: tuple[StudyEntry, ...] = Field(
        (),
        description="Evaluations of the whole run after the fits; they do not affect the verdict.",
    )

    @model_validator(mode="after")
    def _loads_held_out_exist(self) -> ExperimentSpec:
        held, n = self.validation.hold_out.loads, len(self.loads)
        at = ("validate", "hold_out", "loads")
        for i, load in enumerate(held):
            if load >= n:
                message = f"there is no load {load}: `loads` has {n}, counted from 0"
                raise mistake(message, *at, i)
        if len(set(held)) == n:
            raise mistake("holds out every load, so that none is left to fit", *at)
        return self

    @model_validator(mode="after")
    def _under_loads_has_loads_and_models(self) -> ExperimentSpec:
        at = ("validate", "under_loads")
        if not self.validation.under_loads:
            if keys := self.accept.under_loads:
                message = "requires validate: {under_loads: true}"
                raise mistake(message, "accept", keys[0])
            return self
        if len(self.loads) < 2:
            raise mistake("requires a second load in `loads`", *at)
        if isinstance(self.excitation, Dwell):
            raise mistake("requires trajectories, but a dwell program has none", *at)
        if self.excitation.trajectories < FEWEST:
            message = f"must be at least {FEWEST} with validate.under_loads"
            raise mistake(message, "excitation", "trajectories")
        if not self.fit:
            raise mistake("requires a model, but `fit` is empty", *at)
        if self.validation.hold_out.loads:
            message = "must be omitted: under_loads holds out every load except the first"
            raise mistake(message, "validate", "hold_out", "loads")
        return self

    @property
    def hold_out(self) -> HoldOut:
        """Hold-out set of the spec; with `under_loads`, also every load except the first."""
        held = self.validation.hold_out
        if not (self.validation.under_loads and isinstance(self.excitation, Fourier)):
            return held
        changed: dict[str, Any] = {"loads": tuple(range(1, len(self.loads)))}
        if held.trajectories_percent is None:
            changed["trajectories"] = held.trajectories_of(self.excitation.trajectories)
        return held.model_copy(update=changed)

    @model_validator(mode="after")
    def _held_out_motions_are_of_this_program(self) -> ExperimentSpec:
        held, at = self.validation.hold_out, ("validate", "hold_out")
        for key in ("trajectories", "trajectories_percent"):
            if isinstance(self.excitation, Dwell) and getattr(held, key):
                raise mistake("a dwell program has no trajectories: use poses_percent", *at, key)
        if isinstance(self.excitation, Fourier) and held.poses_percent:
            raise mistake("a Fourier program has no poses: use trajectories", *at, "poses_percent")
        return self

    @model_validator(mode="after")
    def _motions_are_left_to_fit_on(self) -> ExperimentSpec:
        held, total, what, key = self._motions_held_out()
        given = getattr(self.validation.hold_out, key) is not None
        if held and held >= total and (given or self.fit):
            message = f"holds out {held} of {total} {what}, so that none is left to fit"
            raise mistake(message, "validate", "hold_out", *([key] if given else []))
        return self

    @model_validator(mode="after")
    def _a_fit_has_something_to_be_judged_on(self) -> ExperimentSpec:
        held, _, what, key = self._motions_held_out()
        if self.fit and not held and not self.validation.hold_out.loads:
            message = (
                f"holds out nothing, so that no model can be evaluated: hold out {what} or loads"
            )
            raise mistake(message, "validate", "hold_out", key)
        return self

    def _motions_held_out(self) -> tuple[int, float, str, str]:
        """Return the number of held-out motions, the total, the kind of motion, and the key."""
        held, program = self.validation.hold_out, self.excitation
        if isinstance(program, Fourier):
            total, drawn = program.trajectories, held.trajectories_percent is not None
            key = "trajectories_percent" if drawn else "trajectories"
            return held.trajectories_of(total), total, "trajectories", key
        if program.file is not None:
            return held.poses_of(100), math.inf, "poses", "poses_percent"  # the file is not read
        return held.poses_of(program.waypoints), program.waypoints, "poses", "poses_percent"

    @model_validator(mode="after")
    def _speed_interlock_lets_the_program_run(self) -> ExperimentSpec:
        fastest = self.excitation.max_velocity_deg_s
        for i, interlock in enumerate(self.interlocks):
            if not (isinstance(interlock, SpeedInterlock) and interlock.enabled):
                continue
            if lowest(interlock.limit_deg_s) <= fastest:
                message = (
                    f"must be above excitation.max_velocity_deg_s ({fastest:g} °/s): reduce that "
                    "limit, or increase this one, at most to the limit of the arm"
                )
                raise mistake(message, "interlocks", i, "limit_deg_s")
        return self


_NEWER_INTERLOCKS = [SpeedScalingInterlock(kind="speed_scaling").model_dump(mode="json")]
"""Default interlocks of newer versions; with default values these interlocks do not affect the
hash."""

_NEWER = (
    ("study",),
    ("excitation", "optimise"),
    ("validate", "under_loads"),
    ("validate", "hold_out", "trajectories_percent"),
    ("accept", "load_error_ratio"),
    ("accept", "contradicted_loads"),
)
"""Paths of keys that were added to the spec format later; unused keys do not affect the hash."""


def spec_hash(spec: ExperimentSpec) -> str:
    """Return the SHA-256 digest of the canonical JSON of the spec, including default values.

    Newer features that a spec does not use (studies, optimised excitation, evaluation with loads,
    random hold-out sets) do not affect the hash. A spec without these features has the same hash as
    before, so that runs of an older version of hil can be resumed. The hash does not depend on
    comments, the order of keys and of interlocks, the spelling of numbers (`1` and `1.0`), or
    defaults that are written out. The hash includes a waypoint file by its content instead of its
    path, so that the hash is the same on every computer.

    Raises:
        SpecError: The waypoint file cannot be read.
    """
    raw = spec.model_dump(mode="json", by_alias=True)
    raw["interlocks"] = [each for each in raw["interlocks"] if each not in _NEWER_INTERLOCKS]
    raw["interlocks"].sort(key=lambda interlock: json.dumps(interlock, sort_keys=True))
    for *parts, key in _NEWER:
        at = raw
        for part in parts:
            at = at[part]
        if not at.get(key):
            at.pop(key, None)
    if file := raw["excitation"].get("file"):
        raw["excitation"]["file"] = _content_hash(Path(file))
    text = json.dumps(_canonical(raw), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _content_hash(file: Path) -> str:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise SpecError(
            f"{file}: cannot be read: {error.strerror}",
            hint="check that the file exists and is readable",
        ) from None


def _canonical(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _canonical(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    # Integral floats become ints; from 2**53 on, a float does not identify a unique integer.
    if isinstance(value, float) and abs(value) < 2**53 and value.is_integer():
        return int(value)
    return value
