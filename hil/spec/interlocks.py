"""Models of the interlocks of an experiment: limits and actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    TypeAdapter,
    WrapValidator,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from hil.spec.field_types import IS_NUMBER, NonNegative, Positive, Strict, Vector3, mistake
from hil.spec.station import Wall

COOLER_C = 5.0
"""Default hysteresis of a temperature pause [°C].

A paused run resumes when the joint is cooler than the limit by this hysteresis.
"""


def one_or_each(kind: Any) -> WrapValidator:
    """Return a validator for one value for all joints, or for a list with one value per joint.

    With a plain union type, each problem would be reported once per member of the union.
    """
    one, each = TypeAdapter(kind), TypeAdapter(Annotated[tuple[kind, ...], Field(min_length=1)])

    def validate(value: Any, handler: Any) -> Any:
        return (each if isinstance(value, list | tuple) else one).validate_python(value)

    return WrapValidator(validate)


Angle = Annotated[float, Field(gt=0, le=1.0), IS_NUMBER]
Celsius = Annotated[float, Field(gt=0, le=150.0), IS_NUMBER]
AnglePerJoint = Annotated[
    Angle | Annotated[tuple[Angle, ...], Field(min_length=1)], one_or_each(Angle)
]
CelsiusPerJoint = Annotated[
    Celsius | Annotated[tuple[Celsius, ...], Field(min_length=1)], one_or_each(Celsius)
]
PositivePerJoint = Annotated[
    Positive | Annotated[tuple[Positive, ...], Field(min_length=1)], one_or_each(Positive)
]

Stop = Annotated[
    Literal["stop"],
    Field(
        description="Reaction of the interlock; a pause is not possible, because moving on to "
        "the next checkpoint would not be safe."
    ),
]
StopOrPause = Annotated[
    Literal["stop", "pause"],
    Field(
        description="Reaction of the interlock: `stop` ends the run; `pause` holds the arm at "
        "the next checkpoint and resumes automatically when the condition has cleared."
    ),
]
Enabled = Annotated[
    bool,
    Field(
        strict=True,
        description="`false` disables the interlock. An interlock that is active by default "
        "can only be disabled in this way.",
    ),
]


class TrackingErrorInterlock(Strict):
    """Stop if the position error of a joint exceeds the limit."""

    kind: Literal["tracking_error"] = Field(description="Monitors the tracking error.")
    limit_rad: AnglePerJoint = Field(
        0.05, description="Maximum distance between measured and commanded position."
    )
    action: Stop = "stop"
    enabled: Enabled = True


class TemperatureInterlock(Strict):
    """Stop or pause if a joint temperature exceeds the limit."""

    kind: Literal["temperature"] = Field(description="Monitors the joint temperatures.")
    limit_c: CelsiusPerJoint = Field(75.0, description="Maximum joint temperature.")
    action: StopOrPause = "stop"
    resume_below_c: Celsius | None = Field(
        None,
        description="With `action: pause`, the run resumes when every joint is cooler than this "
        f"temperature; by default {COOLER_C:g} °C below the limit.",
    )
    enabled: Enabled = True

    @model_validator(mode="after")
    def _cools_down(self) -> TemperatureInterlock:
        if self.resume_below_c is None:
            return self
        if self.action != "pause":
            raise mistake("requires action: pause", "resume_below_c")
        if self.resume_below_c >= lowest(self.limit_c):
            raise mistake(f"must be below limit_c ({lowest(self.limit_c):g} °C)", "resume_below_c")
        return self


class SpeedInterlock(Strict):
    """Stop if a joint speed exceeds the limit."""

    kind: Literal["speed"] = Field(description="Monitors the joint speeds.")
    limit_deg_s: PositivePerJoint = Field(description="Maximum joint speed.")
    action: Stop = "stop"
    enabled: Enabled = True


class CurrentInterlock(Strict):
    """Stop if a motor current exceeds the limit; for robots that measure current."""

    kind: Literal["current"] = Field(description="Monitors the measured motor currents.")
    limit_a: PositivePerJoint = Field(description="Maximum motor current, in either direction.")
    action: Stop = "stop"
    enabled: Enabled = True


class TorqueInterlock(Strict):
    """Stop if a joint torque exceeds the limit."""

    kind: Literal["torque"] = Field(
        description="Monitors the measured torques, or the measured currents multiplied by the "
        "robot's drive gains."
    )
    limit_nm: PositivePerJoint | None = Field(
        None,
        description="Maximum joint torque, in either direction; by default 95 % of the robot's "
        "limits, if torques are measured or the drive gains are known.",
    )
    action: Stop = "stop"
    enabled: Enabled = True


class WorkspaceInterlock(Strict):
    """Stop if the flange, or the tip of a payload of known size, leaves the workspace.

    Motions are planned inside the workspace, with the station's `clearance_m` as distance to its
    faces.
    """

    kind: Literal["workspace"] = Field(description="Monitors the position of the flange.")
    min_m: Vector3 | None = Field(
        None,
        description="Lowest corner of a box in which the flange must stay, in the robot's base "
        "frame.",
    )
    max_m: Vector3 | None = Field(None, description="Highest corner of this box.")
    planes: tuple[Wall, ...] = Field((), description="Planes that the flange must not cross.")
    action: Stop = "stop"
    enabled: Enabled = True

    @model_validator(mode="after")
    def _is_a_space(self) -> WorkspaceInterlock:
        if self.min_m is None and self.max_m is None and not self.planes:
            raise mistake("has no limit: give min_m, max_m or planes")
        for i, (low, high) in enumerate(zip(self.min_m or (), self.max_m or (), strict=False)):
            if low >= high:
                raise mistake(f"must be above min_m ({low:g} m)", "max_m", i)
        return self


class ClearanceInterlock(Strict):
    """Stop if the distance of the arm to itself or to its surroundings falls below the limit."""

    kind: Literal["clearance"] = Field(
        description="Monitors the distances that follow from the measured positions."
    )
    least_m: NonNegative | None = Field(
        None,
        description="Minimum distance; by default half of the station's `clearance_m`, for arms "
        "with collision bodies.",
    )
    action: Stop = "stop"
    enabled: Enabled = True


class StaleInterlock(Strict):
    """Stop if the robot reports no newer state; this interlock cannot be switched off."""

    kind: Literal["stale"] = Field(description="Monitors the robot's clock.")
    after_s: Annotated[float, Field(ge=0.02, le=10.0), IS_NUMBER] = Field(
        0.5, description="Maximum wall time without a newer sample."
    )
    action: Stop = "stop"
    enabled: Annotated[bool, Field(strict=True, description="Always true.")] = True

    @model_validator(mode="after")
    def _stays_on(self) -> StaleInterlock:
        if not self.enabled:
            raise mistake(
                "cannot be disabled: no other interlock detects a lost connection", "enabled"
            )
        return self


class RecorderInterlock(Strict):
    """Stop or pause if the recorder falls behind the measured data."""

    kind: Literal["recorder"] = Field(description="Monitors the recorder.")
    behind_s: Positive = Field(
        2.0, description="Maximum time span of data that wait to be written."
    )
    action: StopOrPause = "stop"
    enabled: Enabled = True


class DiskInterlock(Strict):
    """Stop or pause if the disk of the recording fills up or does not respond."""

    kind: Literal["disk"] = Field(description="Monitors the free space, about once a second.")
    free_mb: Positive = Field(500.0, description="Minimum free space.")
    action: StopOrPause = "stop"
    enabled: Enabled = True


class SpeedScalingInterlock(Strict):
    """Stop or pause if the robot controller moves slower than planned."""

    kind: Literal["speed_scaling"] = Field(
        description="Monitors the speed slider of robots that report it."
    )
    action: StopOrPause = "pause"
    enabled: Enabled = True


class PluggedInterlock(BaseModel):
    """Interlock registered under `hil.interlocks`; further keys are parameters of the plug-in."""

    model_config = ConfigDict(frozen=True, extra="allow")

    kind: str = Field(
        description="Name of a plug-in (entry point in `hil.interlocks`); `hil plugins` lists all."
    )
    action: StopOrPause = "stop"
    enabled: Enabled = True

    @property
    def parameters(self) -> dict[str, Any]:
        """Parameters of the plug-in, as written in the file."""
        return dict(self.model_extra or {})


BuiltIn = (
    TrackingErrorInterlock
    | TemperatureInterlock
    | SpeedInterlock
    | CurrentInterlock
    | TorqueInterlock
    | WorkspaceInterlock
    | ClearanceInterlock
    | StaleInterlock
    | RecorderInterlock
    | DiskInterlock
    | SpeedScalingInterlock
)
INTERLOCK_KINDS: tuple[str, ...] = tuple(
    get_args(model.model_fields["kind"].annotation)[0] for model in get_args(BuiltIn)
)
"""Names of the kinds of built-in interlocks."""


class _ByKind:
    """Validator that selects `PluggedInterlock` for a kind that is not built in.

    The plug-in of an interlock is looked up only when a spec is checked, so that the spec of a run
    can be read on computers without the plug-in.
    """

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_wrap_validator_function(
            self._validate,
            handler.generate_schema(Annotated[BuiltIn, Field(discriminator="kind")]),
            serialization=core_schema.simple_ser_schema("any"),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Return the JSON Schema: a built-in kind, or a different kind with keys of its plug-in."""
        of_kinds = handler(schema)
        plugged = handler(PluggedInterlock.__pydantic_core_schema__)
        kind = handler.resolve_ref_schema(plugged)["properties"]["kind"]
        kind["pattern"] = f"^(?!({'|'.join(INTERLOCK_KINDS)})$)"
        of_kinds["oneOf"].append(plugged)
        return of_kinds

    @staticmethod
    def _validate(value: Any, built_in: Any) -> Any:
        kind = value.get("kind") if isinstance(value, Mapping) else None
        if isinstance(value, PluggedInterlock) or (
            isinstance(kind, str) and kind not in INTERLOCK_KINDS
        ):
            return PluggedInterlock.model_validate(value)
        return built_in(value)


Interlock = Annotated[BuiltIn | PluggedInterlock, _ByKind()]

DEFAULTS: tuple[Interlock, ...] = (
    TrackingErrorInterlock(kind="tracking_error"),
    TemperatureInterlock(kind="temperature"),
    TorqueInterlock(kind="torque"),
    ClearanceInterlock(kind="clearance"),
    StaleInterlock(kind="stale"),
    RecorderInterlock(kind="recorder"),
    DiskInterlock(kind="disk"),
    SpeedScalingInterlock(kind="speed_scaling"),
)
"""Interlocks that monitor every run, unless the spec contains entries of the same kinds."""


def with_defaults(listed: tuple[Interlock, ...]) -> tuple[Interlock, ...]:
    """Return the interlocks of a spec, followed by the default interlocks of all other kinds."""
    kinds = {interlock.kind for interlock in listed}
    return (*listed, *(default for default in DEFAULTS if default.kind not in kinds))


Interlocks = Annotated[tuple[Interlock, ...], AfterValidator(with_defaults)]


def lowest(limit: float | tuple[float, ...]) -> float:
    """Return the lowest value of a limit, which is one number or one number per joint."""
    return min(limit) if isinstance(limit, tuple) else limit
