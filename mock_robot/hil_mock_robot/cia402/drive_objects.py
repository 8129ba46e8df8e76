"""Objects 2100h to 6502h: the drive profile (CiA 402) and what is this maker's own."""

from __future__ import annotations

from functools import partial

from hil_mock_robot.cia402.objects import Group, Object, group

PP, HM, CSP, CSV, CST = 1, 6, 8, 9, 10
MODES = (0, PP, HM, CSP, CSV, CST)
"""Modes of operation that 6060h takes; 0 is none."""

SUPPORTED_MODES = 1 << 0 | 1 << 5 | 1 << 7 | 1 << 8 | 1 << 9
"""Bits of 6502h: profile position, homing, cyclic synchronous position, velocity, torque."""

HOMING_METHODS = (0, 35, 37)
"""None; where it stands is home (35 is the older number of 37)."""

OVERLOAD = 2100
"""Peak torque and current of the drives [‰ of rated]."""

_INCREMENTS, _VELOCITY, _ACCELERATION = "increments", "increments/s", "increments/s²"
_OF_TORQUE, _OF_CURRENT = "‰ of rated torque", "‰ of rated current"

_measured = partial(Object, access="ro", mappable=True, kept=True)
_target = partial(Object, mappable=True)
_setting = partial(Object, locked=True)
_scale = partial(Object, locked=True, low=1)
_limit = partial(Object, per_axis=True, low=1)

_PAYLOAD = group(
    0x2100,
    "Payload",
    [
        Object(0, 1, "Mass", "f32", low=0, high=100, unit="kg", kept=True),
        *(
            Object(0, sub, f"Centre of mass {axis}", "f32", low=-2, high=2, unit="m", kept=True)
            for sub, axis in ((2, "x"), (3, "y"), (4, "z"))
        ),
    ],
)

VENDOR: tuple[Object | Group, ...] = (
    _PAYLOAD,
    Object(0x2101, 0, "Simulated error", "u16", "wo", low=1, note="code of an error: it occurs"),
    _measured(0x2110, 0, "Motor temperature", "i16", default=250, unit="0.1 °C"),
)

_POSITION_LIMITS = group(
    0x607D,
    "Software position limit",
    [
        Object(0, 1, "Minimum", "i32", locked=True, per_axis=True, unit=_INCREMENTS),
        Object(0, 2, "Maximum", "i32", locked=True, per_axis=True, unit=_INCREMENTS),
    ],
    array=True,
)
_ENCODER = group(
    0x608F,
    "Position encoder resolution",
    [
        _scale(0, 1, "Encoder increments", "u32", default=1 << 20),
        _scale(0, 2, "Motor revolutions", "u32", default=1),
    ],
    array=True,
)
_GEAR = group(
    0x6091,
    "Gear ratio",
    [
        _scale(0, 1, "Motor revolutions", "u32", default=1, per_axis=True),
        _scale(0, 2, "Shaft revolutions", "u32", default=1),
    ],
    array=True,
)
_FEED = group(
    0x6092,
    "Feed constant",
    [
        Object(0, 1, "Feed", "u32", "ro", 1, per_axis=True, unit=_INCREMENTS),
        Object(0, 2, "Shaft revolutions", "u32", "ro", 1),
    ],
    array=True,
)
_HOMING_SPEEDS = group(
    0x6099,
    "Homing speeds",
    [
        Object(0, 1, "Speed during search for switch", "u32", unit=_VELOCITY),
        Object(0, 2, "Speed during search for zero", "u32", unit=_VELOCITY),
    ],
    array=True,
)
_INTERPOLATION = group(
    0x60C2,
    "Interpolation time period",
    [
        _setting(0, 1, "Value", "u8", default=4, low=1),
        _setting(0, 2, "Index", "i8", default=-3, low=-6, high=0, note="power of ten of 1 s"),
    ],
)
_OUTPUTS = group(
    0x60FE,
    "Digital outputs",
    [
        _target(0, 1, "Physical outputs", "u32"),
        Object(0, 2, "Bit mask", "u32"),
    ],
    array=True,
)

DRIVE: tuple[Object | Group, ...] = (
    _setting(0x6007, 0, "Abort connection option code", "i16", default=3, choices=(0, 1, 2, 3)),
    Object(0x603F, 0, "Error code", "u16", "ro", mappable=True),
    _target(0x6040, 0, "Controlword", "u16"),
    _measured(0x6041, 0, "Statusword", "u16"),
    _setting(0x605A, 0, "Quick stop option code", "i16", default=2, choices=tuple(range(9))),
    _setting(0x605B, 0, "Shutdown option code", "i16", choices=(0, 1)),
    _setting(0x605C, 0, "Disable operation option code", "i16", default=1, choices=(0, 1)),
    _setting(0x605D, 0, "Halt option code", "i16", default=1, choices=(1, 2, 3, 4)),
    _setting(0x605E, 0, "Fault reaction option code", "i16", default=2, choices=tuple(range(5))),
    _target(0x6060, 0, "Modes of operation", "i8", choices=MODES),
    _measured(0x6061, 0, "Modes of operation display", "i8"),
    _measured(0x6062, 0, "Position demand value", "i32", unit=_INCREMENTS),
    _measured(0x6064, 0, "Position actual value", "i32", unit=_INCREMENTS),
    _limit(0x6065, 0, "Following error window", "u32", unit=_INCREMENTS),
    Object(0x6066, 0, "Following error time out", "u16", default=50, unit="ms"),
    _limit(0x6067, 0, "Position window", "u32", unit=_INCREMENTS),
    Object(0x6068, 0, "Position window time", "u16", default=10, unit="ms"),
    _measured(0x606B, 0, "Velocity demand value", "i32", unit=_VELOCITY),
    _measured(0x606C, 0, "Velocity actual value", "i32", unit=_VELOCITY),
    _target(0x6071, 0, "Target torque", "i16", unit=_OF_TORQUE),
    _target(0x6072, 0, "Max torque", "u16", default=OVERLOAD, high=OVERLOAD, unit=_OF_TORQUE),
    Object(0x6073, 0, "Max current", "u16", default=OVERLOAD, high=OVERLOAD, unit=_OF_CURRENT),
    _measured(0x6074, 0, "Torque demand", "i16", unit=_OF_TORQUE),
    _scale(0x6075, 0, "Motor rated current", "u32", per_axis=True, unit="mA"),
    _scale(0x6076, 0, "Motor rated torque", "u32", per_axis=True, unit="mN·m"),
    _measured(0x6077, 0, "Torque actual value", "i16", unit=_OF_TORQUE),
    _measured(0x6078, 0, "Current actual value", "i16", unit=_OF_CURRENT),
    _measured(0x6079, 0, "DC link circuit voltage", "u32", default=325_000, unit="mV"),
    _target(0x607A, 0, "Target position", "i32", unit=_INCREMENTS),
    Object(0x607C, 0, "Home offset", "i32", unit=_INCREMENTS),
    _POSITION_LIMITS,
    _setting(0x607E, 0, "Polarity", "u8", note="bit 7 position, bit 6 velocity, bit 5 torque"),
    _limit(0x607F, 0, "Max profile velocity", "u32", unit=_VELOCITY),
    _limit(0x6080, 0, "Max motor speed", "u32", unit="1/min"),
    _limit(0x6081, 0, "Profile velocity", "u32", mappable=True, unit=_VELOCITY),
    _limit(0x6083, 0, "Profile acceleration", "u32", unit=_ACCELERATION),
    _limit(0x6084, 0, "Profile deceleration", "u32", unit=_ACCELERATION),
    _limit(0x6085, 0, "Quick stop deceleration", "u32", unit=_ACCELERATION),
    _ENCODER,
    _GEAR,
    _FEED,
    Object(0x6098, 0, "Homing method", "i8", choices=HOMING_METHODS),
    _HOMING_SPEEDS,
    _limit(0x609A, 0, "Homing acceleration", "u32", unit=_ACCELERATION),
    Object(0x60A8, 0, "SI unit position", "u32", "const", 0x00B5_0000, note=_INCREMENTS),
    Object(0x60A9, 0, "SI unit velocity", "u32", "const", 0x00B5_0300, note=_VELOCITY),
    _target(0x60B0, 0, "Position offset", "i32", unit=_INCREMENTS),
    _target(0x60B1, 0, "Velocity offset", "i32", unit=_VELOCITY),
    _target(0x60B2, 0, "Torque offset", "i16", unit=_OF_TORQUE),
    _INTERPOLATION,
    _limit(0x60C5, 0, "Max acceleration", "u32", unit=_ACCELERATION),
    _limit(0x60C6, 0, "Max deceleration", "u32", unit=_ACCELERATION),
    _target(
        0x60E0, 0, "Positive torque limit value", "u16",
        default=OVERLOAD, high=OVERLOAD, unit=_OF_TORQUE,
    ),
    _target(
        0x60E1, 0, "Negative torque limit value", "u16",
        default=OVERLOAD, high=OVERLOAD, unit=_OF_TORQUE,
    ),
    _measured(0x60F4, 0, "Following error actual value", "i32", unit=_INCREMENTS),
    _measured(0x60FD, 0, "Digital inputs", "u32"),
    _OUTPUTS,
    _target(0x60FF, 0, "Target velocity", "i32", unit=_VELOCITY),
    Object(0x6502, 0, "Supported drive modes", "u32", "const", SUPPORTED_MODES),
)  # fmt: skip
