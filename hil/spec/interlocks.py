"""What an experiment may say about interlocks: their limits, and what happens when one trips."""

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
"""A run that was paused for its temperature goes on when the joint is so much cooler [°C]."""


def one_or_each(kind: Any) -> WrapValidator:
    """Validates one value for all joints, or a list with one per joint.

    A plain union would report what is wrong with a value once for each of its members.
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
    Field(description="What happens then: going on to the next checkpoint would not be safe."),
]
StopOrPause = Annotated[
    Literal["stop", "pause"],
    Field(
        description="`pause` holds the arm at the next checkpoint and goes on by itself when all "
        "is well again."
    ),
]
Enabled = Annotated[
    bool,
    Field(strict=True, description="false switches this one off; it is the only way to do so."),
]


class TrackingErrorInterlock(Strict):
    """Stop when a joint is further from its set-point than this."""

    kind: Literal["tracking_error"] = Field(description="Watches the tracking error.")
    limit_rad: AnglePerJoint = Field(
        0.05, description="Largest distance between measured and commanded position."
    )
    action: Stop = "stop"
    enabled: Enabled = True


class TemperatureInterlock(Strict):
    """Stop or pause when a joint is hotter than this."""

    kind: Literal["temperature"] = Field(description="Watches the temperatures.")
    limit_c: CelsiusPerJoint = Field(75.0, description="Highest joint temperature.")
    action: StopOrPause = "stop"
    resume_below_c: Celsius | None = Field(
        None,
        description="With `action: pause`: the run goes on when every joint is cooler than this; "
        f"by default {COOLER_C:g} °C below the limit.",
    )
    enabled: Enabled = True

    @model_validator(mode="after")
    def _cools_down(self) -> TemperatureInterlock:
        if self.resume_below_c is None:
            return self
        if self.action != "pause":
            raise mistake("only an interlock with action: pause resumes", "resume_below_c")
        if self.resume_below_c >= lowest(self.limit_c):
            raise mistake(
                f"must be below the limit of {lowest(self.limit_c):g} °C", "resume_below_c"
            )
        return self


class SpeedInterlock(Strict):
    """Stop when a joint moves faster than this."""

    kind: Literal["speed"] = Field(description="Watches the joint speeds.")
    limit_deg_s: PositivePerJoint = Field(description="Highest joint speed.")
    action: Stop = "stop"
    enabled: Enabled = True


class CurrentInterlock(Strict):
    """Stop when a motor draws more current than this; for robots that measure current."""

    kind: Literal["current"] = Field(description="Watches the measured motor currents.")
    limit_a: PositivePerJoint = Field(description="Highest motor current, in either direction.")
    action: Stop = "stop"
    enabled: Enabled = True


class TorqueInterlock(Strict):
    """Stop when a joint exerts more torque than this."""

    kind: Literal["torque"] = Field(
        description="Watches the measured torques, or currents times the robot's drive gains."
    )
    limit_nm: PositivePerJoint | None = Field(
        None,
        description="Highest joint torque, in either direction; by default 95 % of the robot's own "
        "limits, where torques are measured or the drive gains are known.",
    )
    action: Stop = "stop"
    enabled: Enabled = True


class WorkspaceInterlock(Strict):
    """Stop when the flange, or the tip of a payload of known size, leaves this space.

    Motions are planned inside it, by the station's `clearance_m`.
    """

    kind: Literal["workspace"] = Field(description="Watches where the flange is.")
    min_m: Vector3 | None = Field(
        None, description="Lowest corner of a box it must stay in, in the robot's base frame."
    )
    max_m: Vector3 | None = Field(None, description="Highest corner of that box.")
    planes: tuple[Wall, ...] = Field((), description="Planes it must stay in front of.")
    action: Stop = "stop"
    enabled: Enabled = True

    @model_validator(mode="after")
    def _is_a_space(self) -> WorkspaceInterlock:
        if self.min_m is None and self.max_m is None and not self.planes:
            raise mistake("bounds nothing: give min_m, max_m or planes")
        for i, (low, high) in enumerate(zip(self.min_m or (), self.max_m or (), strict=False)):
            if low >= high:
                raise mistake(f"must be above the {low:g} m of min_m", "max_m", i)
        return self


class ClearanceInterlock(Strict):
    """Stop when the arm comes closer than this to itself or to what stands around it."""

    kind: Literal["clearance"] = Field(description="Watches distances, from measured positions.")
    least_m: NonNegative | None = Field(
        None,
        description="Least distance; by default half of the station's `clearance_m`, for arms with "
        "collision bodies.",
    )
    action: Stop = "stop"
    enabled: Enabled = True


class StaleInterlock(Strict):
    """Stop when the robot's state does not advance; cannot be switched off."""

    kind: Literal["stale"] = Field(description="Watches the robot's clock.")
    after_s: Annotated[float, Field(ge=0.02, le=10.0), IS_NUMBER] = Field(
        0.5, description="Wall time without a newer sample."
    )
    action: Stop = "stop"
    enabled: Annotated[bool, Field(strict=True, description="Always true.")] = True

    @model_validator(mode="after")
    def _stays_on(self) -> StaleInterlock:
        if not self.enabled:
            raise mistake(
                "cannot be switched off: nothing else would notice a dead line", "enabled"
            )
        return self


class RecorderInterlock(Strict):
    """Stop or pause when writing falls behind reading."""

    kind: Literal["recorder"] = Field(description="Watches the recorder.")
    behind_s: Positive = Field(2.0, description="Most data that may wait to be written.")
    action: StopOrPause = "stop"
    enabled: Enabled = True


class DiskInterlock(Strict):
    """Stop or pause when the disk that is recorded to fills up, or does not answer."""

    kind: Literal["disk"] = Field(description="Watches the free space about once a second.")
    free_mb: Positive = Field(500.0, description="Least free space.")
    action: StopOrPause = "stop"
    enabled: Enabled = True


class SpeedScalingInterlock(Strict):
    """Stop or pause when the robot's controller moves slower than planned."""

    kind: Literal["speed_scaling"] = Field(
        description="Watches the speed slider of robots that report it."
    )
    action: StopOrPause = "pause"
    enabled: Enabled = True


class PluggedInterlock(BaseModel):
    """An interlock registered under `hil.interlocks`; further keys are its own parameters."""

    model_config = ConfigDict(frozen=True, extra="allow")

    kind: str = Field(description="Name under `hil.interlocks`; see `hil plugins`.")
    action: StopOrPause = "stop"
    enabled: Enabled = True

    @property
    def parameters(self) -> dict[str, Any]:
        """The plug-in's own parameters, as written."""
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
"""The built-in kinds."""


class _ByKind:
    """Validates a kind that is not built in as `PluggedInterlock`.

    The plug-in itself is looked up when a spec is checked, so the spec of a run can be read where
    its plug-in is not installed.
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
        """One of the built-in kinds, or another kind with keys that its plug-in knows."""
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
"""Watch over every run, unless the spec has entries of the same kind."""


def with_defaults(listed: tuple[Interlock, ...]) -> tuple[Interlock, ...]:
    """What a spec lists, then the defaults of all kinds that it does not list."""
    kinds = {interlock.kind for interlock in listed}
    return (*listed, *(default for default in DEFAULTS if default.kind not in kinds))


Interlocks = Annotated[tuple[Interlock, ...], AfterValidator(with_defaults)]


def lowest(limit: float | tuple[float, ...]) -> float:
    """The lowest of a limit that is one number or one per joint."""
    return min(limit) if isinstance(limit, tuple) else limit
