"""What an experiment YAML may say: typed, frozen, unknown keys refused, units in the keys."""

from __future__ import annotations

import math
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from hil.spec.excitation import Dwell, Excitation, Fourier
from hil.spec.field_types import (
    IS_NUMBER,
    Count,
    Finite,
    FormatVersion,
    Name,
    Positive,
    Strict,
    mistake,
)
from hil.spec.interlocks import (
    DEFAULTS,
    ClearanceInterlock,
    CurrentInterlock,
    DiskInterlock,
    Interlock,
    Interlocks,
    PluggedInterlock,
    RecorderInterlock,
    SpeedInterlock,
    StaleInterlock,
    TemperatureInterlock,
    TorqueInterlock,
    TrackingErrorInterlock,
    WorkspaceInterlock,
    lowest,
)
from hil.spec.judged import (
    Accept,
    ContradictedLimit,
    GapsLimit,
    HoldOut,
    LoadErrorLimit,
    NrmseLimit,
    RmseLimit,
    Validate,
)
from hil.spec.loads import Load
from hil.spec.weigh import OptionalWeigh, Weigh

__all__ = [
    "Accept",
    "ClearanceInterlock",
    "ContradictedLimit",
    "CurrentInterlock",
    "DiskInterlock",
    "Dwell",
    "Excitation",
    "ExperimentSpec",
    "Fit",
    "Fourier",
    "GapsLimit",
    "HoldOut",
    "Interlock",
    "Load",
    "LoadErrorLimit",
    "NrmseLimit",
    "PluggedInterlock",
    "Record",
    "RecorderInterlock",
    "Reference",
    "RmseLimit",
    "SpeedInterlock",
    "StaleInterlock",
    "StudyEntry",
    "TemperatureInterlock",
    "TorqueInterlock",
    "TrackingErrorInterlock",
    "Validate",
    "WarmUp",
    "Weigh",
    "WorkspaceInterlock",
]


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
