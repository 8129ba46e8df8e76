"""What an experiment YAML may say: typed, frozen, unknown keys refused, units in the keys."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from hil.spec.excitation import Dwell, Excitation, Fourier
from hil.spec.loads import Load
from hil.spec.quantities import (
    IS_NUMBER,
    Count,
    Finite,
    FormatVersion,
    Name,
    NonNegative,
    Positive,
    Seed,
    Strict,
    mistake,
)

__all__ = [
    "Accept",
    "Dwell",
    "Excitation",
    "ExperimentSpec",
    "Fit",
    "Fourier",
    "GapsLimit",
    "HoldOut",
    "Interlock",
    "Load",
    "NrmseLimit",
    "Record",
    "Reference",
    "RmseLimit",
    "SpeedInterlock",
    "TemperatureInterlock",
    "TrackingErrorInterlock",
    "Validate",
    "WarmUp",
]


class WarmUp(Strict):
    """Motion before measuring, so that friction has settled at working temperature."""

    duration_s: NonNegative = Field(60.0, description="How long; 0 switches it off.")


class Reference(Strict):
    """One pose that is measured again and again inside a run, to see drift."""

    every: Count = Field(50, description="Poses between two visits; 0 switches it off.")
    q_deg: tuple[Finite, ...] | None = Field(
        None, description="The pose; by default the first pose of the program."
    )


class Record(Strict):
    """What is recorded."""

    rate_hz: Positive | None = Field(None, description="State rate; by default the robot's own.")


class TrackingErrorInterlock(Strict):
    """Stop when a joint is further from its set-point than this."""

    kind: Literal["tracking_error"] = Field(description="Watches the tracking error.")
    limit_rad: Annotated[float, Field(gt=0, le=1.0), IS_NUMBER] = Field(
        description="Largest distance between measured and commanded position."
    )
    action: Literal["stop"] = Field("stop", description="What happens then.")


class TemperatureInterlock(Strict):
    """Stop when a joint is hotter than this."""

    kind: Literal["temperature"] = Field(description="Watches the temperatures.")
    limit_c: Annotated[float, Field(gt=0, le=150.0), IS_NUMBER] = Field(
        description="Highest joint temperature."
    )
    action: Literal["stop"] = Field("stop", description="What happens then.")


class SpeedInterlock(Strict):
    """Stop when a joint moves faster than this."""

    kind: Literal["speed"] = Field(description="Watches the joint speeds.")
    limit_deg_s: Positive = Field(description="Highest joint speed.")
    action: Literal["stop"] = Field("stop", description="What happens then.")


Interlock = Annotated[
    TrackingErrorInterlock | TemperatureInterlock | SpeedInterlock, Field(discriminator="kind")
]


class Fit(BaseModel):
    """One estimator to fit; the keys beside `estimator` are its own parameters."""

    model_config = ConfigDict(frozen=True, extra="allow")

    estimator: str = Field(description="Name under `hil.estimators`, e.g. `static-wls`.")

    @property
    def parameters(self) -> dict[str, Any]:
        """The estimator's own parameters, as written."""
        return dict(self.model_extra or {})


class HoldOut(Strict):
    """What is kept away from the fit and judged on, always whole poses, trajectories or loads."""

    trajectories: Count = Field(0, description="How many of the last trajectories.")
    poses_percent: Annotated[float, Field(ge=0, le=90), IS_NUMBER] = Field(
        20.0, description="Share of the poses, drawn by seed, both approaches together."
    )
    loads: tuple[Count, ...] = Field((), description="Indices into `loads`, from 0.")
    seed: Seed = Field(7, description="Decides which poses are held out.")


class Validate(Strict):
    """How the fitted models are judged."""

    hold_out: HoldOut = Field(HoldOut(), description="What no estimator gets to see.")


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


class Accept(Strict):
    """Criteria for the verdict; with none, the verdict is `not judged`."""

    rmse: RmseLimit | None = Field(None, description="On the held-out data, in the robot's unit.")
    nrmse: NrmseLimit | None = Field(None, description="On the held-out data, without unit.")
    gaps_percent: GapsLimit | None = Field(None, description="On the recording.")


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
    warm_up: WarmUp = Field(WarmUp(), description="Motion before measuring.")
    reference: Reference = Field(Reference(), description="A pose visited again and again.")
    record: Record = Field(Record(), description="What is recorded.")
    interlocks: tuple[Interlock, ...] = Field(
        (
            TrackingErrorInterlock(kind="tracking_error", limit_rad=0.05),
            TemperatureInterlock(kind="temperature", limit_c=75.0),
        ),
        description="What stops the motion; a list given here replaces the default one.",
    )
    fit: tuple[Fit, ...] = Field((), description="The estimators to fit, each on the same data.")
    validation: Validate = Field(
        Validate(), alias="validate", description="How the fitted models are judged."
    )
    accept: Accept = Field(Accept(), description="When the result is good enough.")

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
    def _trajectories_held_out_exist(self) -> ExperimentSpec:
        held, at = self.validation.hold_out.trajectories, ("validate", "hold_out", "trajectories")
        if held and isinstance(self.excitation, Dwell):
            raise mistake("a dwell program has no trajectories: use poses_percent", *at)
        if isinstance(self.excitation, Fourier) and held >= self.excitation.trajectories:
            n = self.excitation.trajectories
            raise mistake(f"holds out {held} of {n} trajectories and leaves none to fit on", *at)
        return self

    @model_validator(mode="after")
    def _speed_interlock_lets_the_program_run(self) -> ExperimentSpec:
        fastest = self.excitation.max_velocity_deg_s
        for i, interlock in enumerate(self.interlocks):
            if isinstance(interlock, SpeedInterlock) and interlock.limit_deg_s <= fastest:
                message = f"must be above the {fastest:g} °/s of excitation.max_velocity_deg_s"
                raise mistake(message, "interlocks", i, "limit_deg_s")
        return self
