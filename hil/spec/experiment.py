"""What an experiment YAML may say: typed, frozen, unknown keys refused, units in the keys.

In the order of the file: what the arm does while it is measured (`Dwell`, `Fourier`, `Optimise`),
what hangs at its flange (`Load`, `Weigh`), how models are judged (`Validate`, `Accept`), and the
whole (`ExperimentSpec`). `spec_hash` is the identity of a spec: a hash of what it says, not of how
it is written.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from hil.arms import Payload
from hil.core import SpecError
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
"""Trajectories with which models are judged under loads."""


class WarmUp(Strict):
    """Motion before measuring, so that friction has settled at working temperature."""

    duration_s: Annotated[float, Field(ge=0, le=14_400), IS_NUMBER] = Field(
        60.0, description="How long; 0 switches it off."
    )


class Reference(Strict):
    """One pose that is measured again and again inside a run, to see drift."""

    every: Count = Field(50, description="Poses between two visits; 0 switches it off.")
    q_deg: tuple[Finite, ...] | None = Field(
        None, description="The pose; by default the first pose of the program."
    )


class Record(Strict):
    """What is recorded."""

    rate_hz: Positive | None = Field(None, description="State rate; by default the robot's own.")
    rotate_mb: Annotated[float, Field(ge=1, allow_inf_nan=False), IS_NUMBER] = Field(
        1024.0, description="A recording goes on in a new file beyond this size."
    )


class Fit(BaseModel):
    """One estimator to fit; the keys beside `estimator` are its own parameters."""

    model_config = ConfigDict(frozen=True, extra="allow")

    estimator: str = Field(description="Name under `hil.estimators`, e.g. `static-wls`.")

    @property
    def parameters(self) -> dict[str, Any]:
        """The estimator's own parameters, as written."""
        return dict(self.model_extra or {})


class StudyEntry(BaseModel):
    """One study of the whole run; the keys beside `study` are its own parameters."""

    model_config = ConfigDict(frozen=True, extra="allow")

    study: str = Field(description="Name under `hil.studies`, e.g. `static-separation`.")

    @property
    def parameters(self) -> dict[str, Any]:
        """The study's own parameters, as written."""
        return dict(self.model_extra or {})


class Dwell(Strict):
    """A dwell program: go to many poses, stand still, measure."""

    kind: Literal["dwell"] = Field(description="Chooses the dwell program.")
    waypoints: Annotated[int, Field(ge=1, le=100_000), IS_NUMBER] = Field(
        650, description="How many poses, well spread over the joint ranges."
    )
    file: str | None = Field(
        None,
        description="CSV file of poses, one per row, one column per joint. An optional first line "
        "names the joints (or `q1` to `q6`), all with `_deg`, all with `_rad`, or all without "
        "either. A relative path starts at the folder of the spec. `waypoints` has no effect then.",
    )
    file_unit: Literal["deg", "rad"] = Field(
        "deg",
        description="Unit of the poses in `file`; not needed if the first line states it. If "
        "neither states it and no angle is beyond 2π, the file is refused.",
    )
    dwell_s: Annotated[float, Field(ge=0.01, le=600), IS_NUMBER] = Field(
        0.095, description="Shortest time at rest before the pose is left."
    )
    samples_per_dwell: Annotated[int, Field(ge=2, le=10_000), IS_NUMBER] = Field(
        10, description="Settled samples taken at every pose."
    )
    settle_rad_s: Positive = Field(
        0.002, description="All joints slower than this over the samples means settled."
    )
    settle_timeout_s: Annotated[float, Field(gt=0, le=600), IS_NUMBER] = Field(
        3.0, description="After this the pose is marked as not settled and left."
    )
    seed: Seed = Field(7, description="Decides which poses are drawn, and their order.")
    max_velocity_deg_s: Positive = Field(60.0, description="Fastest any joint moves.")
    max_acceleration_deg_s2: Positive = Field(80.0, description="Hardest any joint accelerates.")
    max_jerk_deg_s3: Positive = Field(800.0, description="Fastest change of acceleration.")
    approach: Literal["both", "positive", "negative", "free"] = Field(
        "both",
        description="`both` dwells at every pose twice, arriving from below and from above in "
        "every joint; `free` arrives as the way there happens to end.",
    )
    approach_deg: Positive = Field(3.0, description="How far the last stretch to a pose is.")
    range_deg: tuple[JointRange, ...] | None = Field(
        None,
        description="Joint ranges poses are drawn from, one pair per joint; by default those of "
        "the arm.",
    )

    @property
    def stated_unit(self) -> Literal["deg", "rad"] | None:
        """Unit of the poses in `file` if the spec states it."""
        return self.file_unit if "file_unit" in self.model_fields_set else None


class Optimise(Strict):
    """Trajectories found by optimisation, each to complement those before it.

    `optimise: true` is the same as `optimise: {}`; `false` and `null` draw at random.
    """

    objective: Literal["log_det", "condition"] = Field(
        "log_det",
        description="What is made best: `log_det` makes the parameters' errors small (D-optimal), "
        "`condition` the condition number of the base regressor, which says how evenly the "
        "parameters are told and not how well.",
    )
    scaled: bool = Field(
        True,
        description="`condition` with every column of the regressor scaled to length 1; "
        "`false` takes the columns as they are, in mixed units.",
    )
    friction: bool = Field(
        False, description="Also tell Coulomb, viscous and offset friction of each joint apart."
    )
    rotor: bool = Field(
        True, description="Also tell the inertia of each joint's rotor apart from its link's."
    )
    starts: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        3, description="Random starts for each trajectory, of which the best result is kept."
    )
    budget_s: Annotated[float, Field(gt=0, le=86_400), IS_NUMBER] = Field(
        120.0,
        description="Most processor time for one trajectory; when it is reached, the result "
        "depends on the computer.",
    )
    torque_percent: Annotated[float, Field(gt=0, le=100), IS_NUMBER] = Field(
        80.0,
        description="Share of the arm's torque limits that the nominal rigid body with its "
        "heaviest load may need; the rest is left to friction and control.",
    )
    max_jerk_deg_s3: Positive | None = Field(
        None, description="Fastest change of acceleration inside a trajectory; by default no limit."
    )
    clearance_mm: NonNegative | None = Field(
        None,
        description="Distance kept to table, walls and the arm itself; at least the station's "
        "`clearance_m`, which is the default.",
    )
    seed: Seed | None = Field(
        None, description="Decides where the search starts; by default `excitation.seed`."
    )


def _written_short(value: Any) -> Any:
    return {True: {}, False: None}[value] if isinstance(value, bool) else value


OptionalOptimise = Annotated[
    Optimise | None,
    BeforeValidator(_written_short, json_schema_input_type=Optimise | bool | None),
]

LONGEST_TRAJECTORY_S = 3600.0
"""All set-points of one trajectory are in memory together."""


class Fourier(Strict):
    """Finite Fourier series per joint (PINN paper eq. 29), at rest at both ends."""

    kind: Literal["fourier"] = Field(description="Chooses Fourier trajectories.")
    harmonics: Annotated[int, Field(ge=2, le=50), IS_NUMBER] = Field(
        5, description="Order of the series: so many sines and cosines per joint."
    )
    fundamental_hz: Annotated[float, Field(ge=0.001, le=10), IS_NUMBER] = Field(
        0.1, description="Frequency of the first harmonic; its inverse is the period."
    )
    periods: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        1, description="How often each trajectory is repeated without a break."
    )
    trajectories: Annotated[int, Field(ge=1, le=1000), IS_NUMBER] = Field(
        12, description="How many different trajectories, each from rest to rest."
    )
    seed: Seed = Field(7, description="Decides which trajectories are drawn.")
    max_velocity_deg_s: Positive = Field(100.0, description="Fastest any joint moves.")
    max_acceleration_deg_s2: Positive = Field(300.0, description="Hardest any joint accelerates.")
    max_jerk_deg_s3: Positive = Field(
        2000.0, description="For the moves between trajectories, not inside them."
    )
    amplitude_deg: Positive = Field(
        90.0,
        description="Largest excursion from the centre of trajectories that are drawn; optimised "
        "ones only keep to `range_deg`.",
    )
    range_deg: tuple[JointRange, ...] | None = Field(
        None,
        description="Joint ranges the trajectories stay in, one pair per joint; by default those "
        "of the arm.",
    )
    optimise: OptionalOptimise = Field(
        None,
        description="How the trajectories are optimised; `true` takes the defaults, and without "
        "it the best of a few random draws is taken.",
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


Excitation = Annotated[Dwell | Fourier, Field(discriminator="kind")]

# What is longer than ten metres is a slip of the unit, and no flange carries it.
Lever = Annotated[float, Field(ge=-10, le=10), IS_NUMBER]

Extent = Annotated[float, Field(gt=0, le=10), IS_NUMBER]


class Load(Strict):
    """A body mounted at the flange for one pass of the excitation."""

    mass_kg: NonNegative = Field(0.0, description="Mass; 0 is the bare flange.")
    com_m: tuple[Lever, Lever, Lever] = Field(
        (0.0, 0.0, 0.0), description="Centre of mass in the flange frame."
    )
    inertia_kgm2: tuple[Finite, Finite, Finite, Finite, Finite, Finite] = Field(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        description="Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass, flange axes.",
    )
    size_m: tuple[Extent, Extent] | None = Field(
        None,
        description="Length and radius of the payload's body along the flange axis, for collision "
        "checks; a body is assumed from the mass when this is absent.",
    )
    prompt: str = Field("", description="What the operator is asked to do before this load.")

    def payload(self) -> Payload:
        """The same load as the robot and the estimators see it."""
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
    """True when the second moments of mass tr(I)/2·1 − I are positive semidefinite.

    That holds exactly if the principal moments satisfy the triangle inequality (Traversaro et
    al., 'Identification of fully physical consistent inertial parameters', IROS 2016).
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
    """Each load is weighed against the first before it is measured; `weigh: false` switches it off.

    The default tolerances are measured ones: docs/explanation/weighing.md.
    """

    poses: Annotated[int, Field(ge=0, le=10), IS_NUMBER] = Field(
        2, description="How many poses, each from both sides; 0 switches weighing off."
    )
    tolerance_kg: Positive = Field(
        0.15, description="How far from the declared mass the weighed one may be, for any load."
    )
    tolerance_percent: NonNegative = Field(
        10.0, description="So much more of the load's mass difference to the first load."
    )
    tolerance_com_m: Positive = Field(
        0.03, description="How far from the declared centre of mass the weighed one may be."
    )


def _off(value: Any) -> Any:
    return None if value is False else value


OptionalWeigh = Annotated[
    Weigh | None, BeforeValidator(_off, json_schema_input_type=Weigh | Literal[False] | None)
]
"""`weigh: false` and `weigh: null` say the same."""


class HoldOut(Strict):
    """What is kept away from the fit and judged on, always whole poses, trajectories or loads."""

    trajectories: Count | None = Field(
        None,
        description="How many of the last trajectories; by default a quarter of them and at least "
        "one, or none when `loads` is given.",
    )
    trajectories_percent: Annotated[float, Field(ge=0, le=90), IS_NUMBER] | None = Field(
        None,
        description="Share of the trajectories, drawn by seed, in place of `trajectories`; at "
        "least one is held out and one left to fit on, with every load.",
    )
    poses_percent: Annotated[float, Field(ge=0, le=90), IS_NUMBER] | None = Field(
        None,
        description="Share of the poses, drawn by seed, both approaches together; by default 20, "
        "or none when `loads` is given.",
    )
    loads: tuple[Count, ...] = Field(
        (),
        description="Indices into `loads`, from 0. With `trajectories`, `trajectories_percent` or "
        "`poses_percent` beside it, the model is judged on motions *and* loads it has not seen, "
        "together.",
    )
    seed: Seed = Field(7, description="Decides which poses or trajectories are drawn.")

    @model_validator(mode="after")
    def _trajectories_are_chosen_one_way(self) -> HoldOut:
        if self.trajectories is not None and self.trajectories_percent is not None:
            raise mistake(
                "`trajectories` chooses the last ones, this one draws: keep one of the two",
                "trajectories_percent",
            )
        return self

    def trajectories_of(self, total: int) -> int:
        """How many of `total` different trajectories are held out."""
        if self.trajectories is not None:
            return self.trajectories
        if self.trajectories_percent is not None:
            count = round(self.trajectories_percent / 100 * total)
            return max(1, min(count, total - 1)) if self.trajectories_percent else 0
        return 0 if self.loads else max(1, total // 4)

    def poses_of(self, total: int) -> int:
        """How many of `total` different poses are held out."""
        default = 0.0 if self.loads else 20.0
        percent = default if self.poses_percent is None else self.poses_percent
        return max(1, round(percent / 100 * total)) if percent else 0


class Validate(Strict):
    """How the fitted models are judged."""

    hold_out: HoldOut = Field(HoldOut(), description="What no estimator gets to see.")
    under_loads: bool = Field(
        False,
        description="Fit to the first load alone, and judge every model under the others as well: "
        "unaware of the load, told of it as declared, and as identified; declared loads are "
        "checked.",
    )


class RmseLimit(Strict):
    """Largest root-mean-square error accepted on the held-out data."""

    max: Positive = Field(description="The limit, in `unit`.")
    unit: Literal["A", "N·m", "Nm"] = Field(description="What the robot's effort is measured in.")
    per: Literal["joint", "mean"] = Field(
        "mean", description="Whether every joint must keep the limit, or their mean."
    )
    signal: Literal["raw", "filtered"] = Field(
        "raw", description="Whether the measured effort is low-pass filtered before comparing."
    )


class NrmseLimit(Strict):
    """Largest RMSE over the standard deviation of the signal."""

    max: Positive = Field(description="The limit, without unit (0.1 is 10 %).")
    per: Literal["joint", "mean"] = Field(
        "mean", description="Whether every joint must keep the limit, or their mean."
    )


class GapsLimit(Strict):
    """Largest share of missing samples."""

    max: NonNegative = Field(description="The limit, in percent of the samples expected.")


class LoadErrorLimit(Strict):
    """Largest error under a load that a model is told of, over its error with the first load."""

    max: Positive = Field(description="The limit, without unit; both are means over the joints.")
    told: Literal["declared", "calibrated"] = Field(
        "declared",
        description="What the model is told: the load as declared, or that and drive gains as the "
        "other loads tell them.",
    )
    of: Literal["every", "first"] = Field(
        "every",
        description="Whether every estimator must keep it, or the first of `fit`, with the others "
        "beside it for comparison.",
    )


class ContradictedLimit(Strict):
    """How many declared loads may be contradicted by those identified."""

    max: Count = Field(description="The limit; a load that cannot be identified counts.")


class Accept(Strict):
    """Criteria for the verdict; without any for models: `not judged`, or `rejected` by gaps."""

    rmse: RmseLimit | None = Field(None, description="On the held-out data, in the robot's unit.")
    nrmse: NrmseLimit | None = Field(None, description="On the held-out data, without unit.")
    gaps_percent: GapsLimit | None = Field(None, description="On the recording.")
    load_error_ratio: LoadErrorLimit | None = Field(
        None, description="Under any load that it is told of; with `validate.under_loads`."
    )
    contradicted_loads: ContradictedLimit | None = Field(
        None, description="Of those declared, by the first estimator; with `validate.under_loads`."
    )

    @property
    def under_loads(self) -> tuple[str, ...]:
        """Keys of the criteria that are about loads."""
        keys = ("load_error_ratio", "contradicted_loads")
        return tuple(key for key in keys if getattr(self, key) is not None)


class ExperimentSpec(Strict):
    """One experiment, from excitation to acceptance."""

    hil: FormatVersion = Field(description="Version of the spec format.")
    name: Name = Field(description="Names the run directories; letters, digits, `_`, `.`, `-`.")
    description: str = Field("", description="What this is for; shown in the report.")
    robot: str = Field(description="A robot of the station.")
    excitation: Excitation = Field(description="What the arm does while it is measured.")
    loads: tuple[Load, ...] = Field(
        (Load(),), min_length=1, description="The excitation runs once with each of these."
    )
    weigh: OptionalWeigh = Field(
        Weigh(), description="How the loads are weighed; `false` or `null`: not at all."
    )
    warm_up: WarmUp = Field(WarmUp(), description="Motion before measuring.")
    reference: Reference = Field(Reference(), description="A pose visited again and again.")
    record: Record = Field(Record(), description="What is recorded.")
    interlocks: Interlocks = Field(
        DEFAULTS,
        description="What stops or pauses the motion; the defaults of kinds that are not listed "
        "here stay.",
    )
    fit: tuple[Fit, ...] = Field((), description="The estimators to fit, each on the same data.")
    validation: Validate = Field(
        Validate(), alias="validate", description="How the fitted models are judged."
    )
    accept: Accept = Field(Accept(), description="When the result is good enough.")
    study: tuple[StudyEntry, ...] = Field(
        (), description="Evaluations of the whole run, made after the fits; never judged."
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
            raise mistake("holds out every load and leaves none to fit on", *at)
        return self

    @model_validator(mode="after")
    def _under_loads_has_loads_and_models(self) -> ExperimentSpec:
        at = ("validate", "under_loads")
        if not self.validation.under_loads:
            if keys := self.accept.under_loads:
                message = "is judged only with validate: {under_loads: true}"
                raise mistake(message, "accept", keys[0])
            return self
        if len(self.loads) < 2:
            raise mistake("there is no load besides the first: `loads` needs a second", *at)
        if isinstance(self.excitation, Dwell):
            raise mistake("judges trajectories, and a dwell program has none", *at)
        if self.excitation.trajectories < FEWEST:
            message = f"must be at least {FEWEST} with validate.under_loads"
            raise mistake(message, "excitation", "trajectories")
        if not self.fit:
            raise mistake("there is no model to judge: `fit` is empty", *at)
        if self.validation.hold_out.loads:
            message = "under_loads holds out every load but the first: leave this away"
            raise mistake(message, "validate", "hold_out", "loads")
        return self

    @property
    def hold_out(self) -> HoldOut:
        """What is held out: as written, and with `under_loads` every load but the first."""
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
            message = f"holds out {held} of {total} {what} and leaves none to fit on"
            raise mistake(message, "validate", "hold_out", *([key] if given else []))
        return self

    @model_validator(mode="after")
    def _a_fit_has_something_to_be_judged_on(self) -> ExperimentSpec:
        held, _, what, key = self._motions_held_out()
        if self.fit and not held and not self.validation.hold_out.loads:
            message = f"holds out nothing, so no model can be judged: give {what} or loads"
            raise mistake(message, "validate", "hold_out", key)
        return self

    def _motions_held_out(self) -> tuple[int, float, str, str]:
        """How many are held out, of how many, what they are, and the key that says so."""
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
                    f"must be above the {fastest:g} °/s of excitation.max_velocity_deg_s: lower "
                    "that one, or raise this one as far as the arm goes"
                )
                raise mistake(message, "interlocks", i, "limit_deg_s")
        return self


_NEWER_INTERLOCKS = [SpeedScalingInterlock(kind="speed_scaling").model_dump(mode="json")]
"""Interlocks that watch by default since then; as they are by default they leave no trace."""

_NEWER = (
    ("study",),
    ("excitation", "optimise"),
    ("validate", "under_loads"),
    ("validate", "hold_out", "trajectories_percent"),
    ("accept", "load_error_ratio"),
    ("accept", "contradicted_loads"),
)
"""Keys that came after runs were hashed, and where; unused they count as not there."""


def spec_hash(spec: ExperimentSpec) -> str:
    """sha256 of the canonical JSON of the spec, defaults included.

    What a spec does not use of studies, optimised excitation, judging under loads and drawn
    trajectories leaves no trace: it has the hash it had before there were any, and runs of an
    older hil go on.
    Comments, order of keys and of interlocks, spelling of numbers (`1` and `1.0`) and written-out
    defaults do not change it. A file of poses counts with its content, not with its path, so that
    the hash is the same on every machine.

    Raises:
        SpecError: The file of poses cannot be read.
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
            hint="see whether it exists and may be read",
        ) from None


def _canonical(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _canonical(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_canonical(item) for item in value]
    # Integral floats become ints; beyond 2**53 a float is not one particular integer any more.
    if isinstance(value, float) and abs(value) < 2**53 and value.is_integer():
        return int(value)
    return value
