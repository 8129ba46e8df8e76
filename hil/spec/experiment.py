"""What an experiment YAML may say: typed, frozen, unknown keys refused, units in the keys."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from hil.payload import Payload

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector3 = tuple[Finite, Finite, Finite]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]


class Strict(BaseModel):
    """Base of every spec part: immutable, and a key nobody knows is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)


class Load(Strict):
    """A body mounted at the flange for one pass of the excitation."""

    mass_kg: NonNegative = 0.0
    com_m: Vector3 = Field((0.0, 0.0, 0.0), description="Centre of mass in the flange frame [m].")
    inertia_kgm2: tuple[Finite, Finite, Finite, Finite, Finite, Finite] = Field(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        description="Ixx, Iyy, Izz, Ixy, Ixz, Iyz about the centre of mass, flange axes.",
    )
    size_m: tuple[Positive, Positive] | None = Field(
        None,
        description="Length and radius of the payload's body along the flange axis, for collision "
        "checks; a body is assumed from the mass when this is absent.",
    )
    prompt: str = Field("", description="What the operator is asked to do before this load.")

    def payload(self) -> Payload:
        """The same load as the robot and the estimators see it."""
        return Payload(self.mass_kg, self.com_m, self.inertia_kgm2)


class WarmUp(Strict):
    """Motion before measuring, so that friction has settled at working temperature."""

    duration_s: NonNegative = 60.0


class Reference(Strict):
    """One pose that is measured again and again inside a run, to see drift."""

    every: int = Field(50, ge=0, description="Poses between two visits; 0 switches it off.")
    q_deg: tuple[Finite, ...] | None = Field(
        None, description="The pose; by default the first pose of the program."
    )


class Dwell(Strict):
    """A dwell program: go to many poses, stand still, measure."""

    kind: Literal["dwell"]
    waypoints: int = Field(650, ge=1, le=100_000)
    file: str | None = Field(
        None, description="CSV with the lab's own poses, one per row, one column per joint."
    )
    file_unit: Literal["deg", "rad"] = "deg"
    dwell_s: Annotated[float, Field(ge=0.01, le=600)] = Field(
        0.095, description="Shortest time at rest before the pose is left."
    )
    samples_per_dwell: int = Field(10, ge=2, le=10_000)
    settle_rad_s: Positive = Field(
        0.002, description="All joints slower than this over the samples means settled."
    )
    settle_timeout_s: Positive = Field(
        3.0, description="After this the pose is marked as not settled and left."
    )
    seed: int = 7
    max_velocity_deg_s: Positive = 60.0
    max_acceleration_deg_s2: Positive = 80.0
    max_jerk_deg_s3: Positive = 800.0
    approach: Literal["both", "positive", "negative", "free"] = Field(
        "both",
        description="`both` dwells at every pose twice, arriving from below and from above in "
        "every joint; `free` arrives as the way there happens to end.",
    )
    approach_deg: Positive = Field(3.0, description="How far the last stretch to a pose is.")
    range_deg: tuple[tuple[Finite, Finite], ...] | None = Field(
        None, description="Joint ranges poses are drawn from, one pair per joint."
    )


class Fourier(Strict):
    """Finite Fourier series per joint (PINN paper eq. 29), at rest at both ends."""

    kind: Literal["fourier"]
    harmonics: int = Field(5, ge=2, le=50)
    fundamental_hz: Positive = 0.1
    periods: int = Field(1, ge=1, le=1000)
    trajectories: int = Field(12, ge=1, le=1000)
    seed: int = 7
    max_velocity_deg_s: Positive = 100.0
    max_acceleration_deg_s2: Positive = 300.0
    max_jerk_deg_s3: Positive = Field(
        2000.0, description="For the moves between trajectories, not inside them."
    )
    amplitude_deg: Positive = Field(90.0, description="Largest excursion from the centre.")
    range_deg: tuple[tuple[Finite, Finite], ...] | None = None


Excitation = Annotated[Dwell | Fourier, Field(discriminator="kind")]


class Record(Strict):
    """What is recorded."""

    rate_hz: Positive | None = Field(None, description="State rate; by default the robot's own.")


class TrackingErrorInterlock(Strict):
    """Stop when a joint is further from its set-point than this."""

    kind: Literal["tracking_error"]
    limit_rad: Positive
    action: Literal["stop"] = "stop"


class TemperatureInterlock(Strict):
    """Stop when a joint is hotter than this."""

    kind: Literal["temperature"]
    limit_c: Positive
    action: Literal["stop"] = "stop"


class SpeedInterlock(Strict):
    """Stop when a joint moves faster than this."""

    kind: Literal["speed"]
    limit_deg_s: Positive
    action: Literal["stop"] = "stop"


Interlock = Annotated[
    TrackingErrorInterlock | TemperatureInterlock | SpeedInterlock, Field(discriminator="kind")
]


class Fit(BaseModel):
    """One estimator to fit; the keys beside `estimator` are its own parameters."""

    model_config = ConfigDict(frozen=True, extra="allow")

    estimator: str

    @property
    def parameters(self) -> dict[str, Any]:
        """The estimator's own parameters, as written."""
        return dict(self.model_extra or {})


class HoldOut(Strict):
    """What is kept away from the fit and judged on, always whole poses, trajectories or loads."""

    trajectories: int = Field(0, ge=0, description="How many of the last trajectories.")
    poses_percent: Annotated[float, Field(ge=0, le=90)] = Field(
        20.0, description="Share of the poses, drawn by seed, both approaches together."
    )
    loads: tuple[int, ...] = Field((), description="Indices into `loads`, from 0.")
    seed: int = 7


class Validate(Strict):
    """How the fitted models are judged."""

    hold_out: HoldOut = HoldOut()


class RmseLimit(Strict):
    """Largest root-mean-square error accepted on the held-out data."""

    max: Positive
    unit: Literal["A", "N·m", "Nm"]
    per: Literal["joint", "mean"] = "mean"
    signal: Literal["raw", "filtered"] = "raw"


class NrmseLimit(Strict):
    """Largest RMSE over the standard deviation of the signal."""

    max: Positive
    per: Literal["joint", "mean"] = "mean"


class GapsLimit(Strict):
    """Largest share of missing samples."""

    max: NonNegative


class Accept(Strict):
    """Criteria for the verdict; with none, the verdict is `not judged`."""

    rmse: RmseLimit | None = None
    nrmse: NrmseLimit | None = None
    gaps_percent: GapsLimit | None = None


class ExperimentSpec(Strict):
    """One experiment, from excitation to acceptance."""

    hil: Literal[1] = Field(description="Version of the spec format.")
    name: Name
    description: str = ""
    robot: str = Field(description="A robot of the station.")
    excitation: Excitation
    loads: tuple[Load, ...] = Field((Load(),), min_length=1)
    warm_up: WarmUp = WarmUp()
    reference: Reference = Reference()
    record: Record = Record()
    interlocks: tuple[Interlock, ...] = (
        TrackingErrorInterlock(kind="tracking_error", limit_rad=0.05),
        TemperatureInterlock(kind="temperature", limit_c=75.0),
    )
    fit: tuple[Fit, ...] = ()
    validation: Validate = Field(Validate(), alias="validate")
    accept: Accept = Accept()

    @model_validator(mode="after")
    def _loads_held_out_exist(self) -> ExperimentSpec:
        missing = [i for i in self.validation.hold_out.loads if not 0 <= i < len(self.loads)]
        if missing:
            raise ValueError(
                f"validate.hold_out.loads names load {missing[0]}, "
                f"but there are {len(self.loads)} loads, counted from 0"
            )
        return self
