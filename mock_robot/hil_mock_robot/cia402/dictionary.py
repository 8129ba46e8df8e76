"""Object dictionary of one mock drive: table of the objects, and formats derived from it.

`Object` and `Group` describe one entry of the dictionary. The table of objects consists of
`COMMUNICATION` (CiA 301), `VENDOR` and `DRIVE` (CiA 402). `registers_of` returns the values after
power-on for the drive of one joint. `object_dictionary` returns the dictionary for the `canopen`
library, and `eds_of` returns an EDS file for other tools.
"""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import canopen
import numpy as np
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from hil.arms import ArmDescription
from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.keys import Registers, key

Value = int | float | str

CODES = {"i8": "b", "u8": "B", "i16": "h", "u16": "H", "i32": "i", "u32": "I", "f32": "I"}
"""`struct` code of each data type in `Registers`; a REAL32 is stored as its 32 bits."""


@dataclass(frozen=True, slots=True)
class Object:
    """One variable of the object dictionary.

    Attributes:
        index: Index of the object.
        sub: Sub-index of the object.
        name: Name of the object.
        type: Data type: a key of `CODES`, `text` or `domain`. Values of type `text` and `domain`
            are not stored in `Registers`.
        access: Access type: `rw`, `ro`, `wo` or `const`.
        default: Value after a reset, unless the value depends on the axis.
        mappable: Whether a PDO can contain the object.
        low: Minimum value that can be written; None for the minimum of the data type.
        high: Maximum value that can be written; None for the maximum of the data type.
        choices: Permitted values of an object whose values are not a range.
        unit: Unit as in the standard; empty for a value without a unit.
        locked: Whether the object cannot be written in the states operation enabled, quick stop
            active and fault reaction active.
        stays: Whether a reset keeps the value, because the value is a property of the machine and
            not a setting.
        per_axis: Whether the value after a reset depends on the axis.
        node_relative: Whether the node id is added to the default.
        note: Remark in addition to the name.
    """

    index: int
    sub: int
    name: str
    type: str
    access: str = "rw"
    default: Value = 0
    mappable: bool = False
    low: int | None = None
    high: int | None = None
    choices: tuple[int, ...] = ()
    unit: str = ""
    locked: bool = False
    stays: bool = False
    per_axis: bool = False
    node_relative: bool = False
    note: str = ""

    @property
    def key(self) -> int:
        """Key of the object's value in `Registers`."""
        return key(self.index, self.sub)

    @property
    def readable(self) -> bool:
        """Whether an SDO client can read the object, and a TPDO can contain the object."""
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        """Whether an SDO client can write the object, and an RPDO can contain the object."""
        return self.access in ("rw", "wo")

    @property
    def packing(self) -> struct.Struct:
        """`struct` layout of the object's value in `Registers`."""
        return struct.Struct("<" + CODES[self.type])

    @property
    def bits(self) -> int:
        """Length of the object's value in a PDO [bits]."""
        return 8 * self.packing.size

    def allows(self, value: float) -> bool:
        """Return whether a client can write a value to the object; never for NaN."""
        if self.choices:
            return value in self.choices
        low, high = self.low, self.high
        if low is None and high is None:
            return value == value
        return (low is None or value >= low) and (high is None or value <= high)


@dataclass(frozen=True, slots=True)
class Group:
    """Object with sub-indices.

    Attributes:
        index: Index of the object.
        name: Name of the object.
        members: Sub-objects in the order of their sub-indices; the first sub-object contains the
            highest sub-index.
        array: Whether all members except the first have the same type.
    """

    index: int
    name: str
    members: tuple[Object, ...]
    array: bool = False


def group(index: int, name: str, members: Iterable[Object], *, array: bool = False) -> Group:
    """Return a group of members with their sub-indices, preceded by sub-index 0.

    Args:
        index: Index of the group, which replaces the index of the members.
        name: Name of the group.
        members: Members in the order of their sub-indices.
        array: Whether all members have the same type.
    """
    placed = tuple(replace(member, index=index) for member in members)
    first = Object(index, 0, "Highest sub-index supported", "u8", "const", placed[-1].sub)
    return Group(index, name, (first, *placed), array)


def real(raw: int) -> float:
    """Return the number that the 32 bits of a REAL32 encode."""
    return float(struct.unpack("<f", struct.pack("<I", raw & 0xFFFF_FFFF))[0])


def raw_real(value: float) -> int:
    """Return the 32 bits that encode a number as REAL32."""
    return int(struct.unpack("<I", struct.pack("<f", value))[0])


DEVICE_TYPE = 0x0002_0192
"""Device type of a servo drive of profile 402."""

NOT_VALID, NO_RTR = 1 << 31, 1 << 30
"""Bits in the COB-ID of a PDO: the PDO is invalid, remote frames are not permitted."""

N_PDOS = 4
N_MAPPED = 8
RPDO_PARAMETERS, RPDO_MAPPING, TPDO_PARAMETERS, TPDO_MAPPING = 0x1400, 0x1600, 0x1800, 0x1A00
EVENT_DRIVEN = 255

TRANSMISSION_TYPES = (*range(241), 254, 255)
"""Valid transmission types of PDOs.

The types 241 to 251 are reserved. The types 252 and 253 use remote frames, which the mock drives do
not support.
"""

HISTORY = 8
"""Maximum number of errors in the error list (1003h)."""

N_CONSUMED = 2
"""Number of heartbeat producers that 1016h can monitor."""

_CONTROLWORD, _MODE, _TARGET_POSITION, _TARGET_VELOCITY = (
    0x6040_0010, 0x6060_0008, 0x607A_0020, 0x60FF_0020,
)  # fmt: skip

RPDO_DEFAULTS = (
    (_CONTROLWORD,),
    (_CONTROLWORD, _MODE),
    (_CONTROLWORD, _TARGET_POSITION),
    (_CONTROLWORD, _TARGET_VELOCITY),
)

_STATUSWORD, _MODE_DISPLAY, _POSITION_ACTUAL, _VELOCITY_ACTUAL = (
    0x6041_0010, 0x6061_0008, 0x6064_0020, 0x606C_0020,
)  # fmt: skip

TPDO_DEFAULTS = (
    (_STATUSWORD,),
    (_STATUSWORD, _MODE_DISPLAY),
    (_STATUSWORD, _POSITION_ACTUAL),
    (_STATUSWORD, _VELOCITY_ACTUAL),
)
"""Generic PDOs of CiA 402; after a reset only the first PDO of each direction is valid."""

_ERRORS = Group(
    0x1003,
    "Pre-defined error field",
    (
        Object(0x1003, 0, "Number of errors", "u8", choices=(0,), note="0 clears the errors"),
        *(
            Object(0x1003, sub, f"Error {sub}", "u32", "ro", note="error code, newest first")
            for sub in range(1, HISTORY + 1)
        ),
    ),
    array=True,
)

_CONSUMERS = group(
    0x1016,
    "Consumer heartbeat time",
    [
        Object(0, sub, f"Consumer {sub}", "u32", high=0x7F_FFFF, unit="node << 16 | ms")
        for sub in range(1, N_CONSUMED + 1)
    ],
    array=True,
)

_IDENTITY = group(
    0x1018,
    "Identity",
    [
        Object(0, 1, "Vendor-ID", "u32", "ro", 0, note="no vendor: a simulated drive"),
        Object(0, 2, "Product code", "u32", "ro", 0x402),
        Object(0, 3, "Revision number", "u32", "ro", 0x0001_0000),
        Object(0, 4, "Serial number", "u32", "ro", 1, per_axis=True),
    ],
)

_REACTIONS = group(
    0x1029,
    "Error behaviour",
    [
        Object(
            0, 1, "Communication error", "u8", choices=(0, 1, 2),
            note="0 pre-operational, 1 no change, 2 stopped",
        ),
    ],
    array=True,
)  # fmt: skip


def _pdo(number: int, *, transmit: bool) -> tuple[Group, Group]:
    way = "transmit" if transmit else "receive"
    base, parameters, mapping, defaults = (
        (0x180, TPDO_PARAMETERS, TPDO_MAPPING, TPDO_DEFAULTS)
        if transmit
        else (0x200, RPDO_PARAMETERS, RPDO_MAPPING, RPDO_DEFAULTS)
    )
    cob_id = base + 0x100 * number | NO_RTR | (NOT_VALID if number else 0)
    name = f"PDO {number + 1} {way}"
    return (
        _parameters(parameters + number, f"{name} parameters", cob_id, inhibited=transmit),
        _mapping(mapping + number, f"{name} mapping", defaults[number]),
    )


def _parameters(index: int, name: str, cob_id: int, *, inhibited: bool) -> Group:
    members = [
        Object(0, 1, "COB-ID", "u32", default=cob_id, node_relative=True),
        Object(0, 2, "Transmission type", "u8", default=EVENT_DRIVEN, choices=TRANSMISSION_TYPES),
    ]
    if inhibited:
        members.append(Object(0, 3, "Inhibit time", "u16", unit="100 us"))
    members.append(Object(0, 5, "Event timer", "u16", unit="ms"))
    return group(index, name, members)


def _mapping(index: int, name: str, entries: tuple[int, ...]) -> Group:
    filled = entries + (0,) * (N_MAPPED - len(entries))
    members = [
        Object(0, sub, f"Mapped object {sub}", "u32", default=entry)
        for sub, entry in enumerate(filled, start=1)
    ]
    first = Object(
        index, 0, "Number of mapped objects", "u8", default=len(entries), high=N_MAPPED
    )  # fmt: skip
    return Group(index, name, (first, *group(index, name, members).members[1:]))


COMMUNICATION: tuple[Object | Group, ...] = (
    Object(0x1000, 0, "Device type", "u32", "const", DEVICE_TYPE),
    Object(0x1001, 0, "Error register", "u8", "ro", mappable=True),
    _ERRORS,
    Object(0x1005, 0, "COB-ID SYNC", "u32", default=0x80, choices=(0x80,)),
    Object(0x1006, 0, "Communication cycle period", "u32", unit="us"),
    Object(0x1008, 0, "Device name", "text", "const", "HIL mock drive"),
    Object(0x1009, 0, "Hardware version", "text", "const", "simulated"),
    Object(0x100A, 0, "Software version", "text", "const", "1"),
    Object(0x1014, 0, "COB-ID EMCY", "u32", default=0x80, node_relative=True),
    _CONSUMERS,
    Object(0x1017, 0, "Producer heartbeat time", "u16", unit="ms"),
    _IDENTITY,
    Object(0x1021, 0, "Store EDS", "domain", "ro", note="this dictionary as an EDS file"),
    Object(0x1022, 0, "Store format", "u16", "ro", note="0: plain text"),
    _REACTIONS,
    *(part for number in range(N_PDOS) for part in _pdo(number, transmit=False)),
    *(part for number in range(N_PDOS) for part in _pdo(number, transmit=True)),
)

PP, HM, CSP, CSV, CST = 1, 6, 8, 9, 10

MODES = (0, PP, HM, CSP, CSV, CST)
"""Modes of operation that 6060h accepts; 0 means no mode."""

SUPPORTED_MODES = 1 << 0 | 1 << 5 | 1 << 7 | 1 << 8 | 1 << 9
"""Bits of 6502h for profile position, homing, and cyclic synchronous position/velocity/torque."""

HOMING_METHODS = (0, 35, 37)
"""Homing methods: no homing, or home at the present position (35 is the older number of 37)."""

OVERLOAD = 2100
"""Peak torque and peak current of the drives [‰ of the rated values]."""

_PAYLOAD = group(
    0x2100,
    "Payload",
    [
        Object(0, 1, "Mass", "f32", low=0, high=100, unit="kg", stays=True),
        *(
            Object(
                0,
                sub,
                f"Centre of mass {axis}",
                "f32",
                low=-2,
                high=2,
                unit="m",
                stays=True,
            )
            for sub, axis in ((2, "x"), (3, "y"), (4, "z"))
        ),
    ],
)

_measured = partial(Object, access="ro", mappable=True, stays=True)

VENDOR: tuple[Object | Group, ...] = (
    _PAYLOAD,
    Object(0x2101, 0, "Simulated error", "u16", "wo", low=1, note="a code causes its error"),
    _measured(0x2110, 0, "Motor temperature", "i16", default=250, unit="0.1 °C"),
)

_setting = partial(Object, locked=True)
_target = partial(Object, mappable=True)
_INCREMENTS, _SPEED_UNIT, _ACCELERATION_UNIT = "increments", "increments/s", "increments/s²"
_limit = partial(Object, per_axis=True, low=1)
_OF_TORQUE, _OF_CURRENT = "‰ of rated torque", "‰ of rated current"
_scale = partial(Object, locked=True, low=1)

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
        Object(0, 1, "Speed during search for switch", "u32", unit=_SPEED_UNIT),
        Object(0, 2, "Speed during search for zero", "u32", unit=_SPEED_UNIT),
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
    _measured(0x606B, 0, "Velocity demand value", "i32", unit=_SPEED_UNIT),
    _measured(0x606C, 0, "Velocity actual value", "i32", unit=_SPEED_UNIT),
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
    _limit(0x607F, 0, "Max profile velocity", "u32", unit=_SPEED_UNIT),
    _limit(0x6080, 0, "Max motor speed", "u32", unit="1/min"),
    _limit(0x6081, 0, "Profile velocity", "u32", mappable=True, unit=_SPEED_UNIT),
    _limit(0x6083, 0, "Profile acceleration", "u32", unit=_ACCELERATION_UNIT),
    _limit(0x6084, 0, "Profile deceleration", "u32", unit=_ACCELERATION_UNIT),
    _limit(0x6085, 0, "Quick stop deceleration", "u32", unit=_ACCELERATION_UNIT),
    _ENCODER,
    _GEAR,
    _FEED,
    Object(0x6098, 0, "Homing method", "i8", choices=HOMING_METHODS),
    _HOMING_SPEEDS,
    _limit(0x609A, 0, "Homing acceleration", "u32", unit=_ACCELERATION_UNIT),
    Object(0x60A8, 0, "SI unit position", "u32", "const", 0x00B5_0000, note=_INCREMENTS),
    Object(0x60A9, 0, "SI unit velocity", "u32", "const", 0x00B5_0300, note=_SPEED_UNIT),
    _target(0x60B0, 0, "Position offset", "i32", unit=_INCREMENTS),
    _target(0x60B1, 0, "Velocity offset", "i32", unit=_SPEED_UNIT),
    _target(0x60B2, 0, "Torque offset", "i16", unit=_OF_TORQUE),
    _INTERPOLATION,
    _limit(0x60C5, 0, "Max acceleration", "u32", unit=_ACCELERATION_UNIT),
    _limit(0x60C6, 0, "Max deceleration", "u32", unit=_ACCELERATION_UNIT),
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
    _target(0x60FF, 0, "Target velocity", "i32", unit=_SPEED_UNIT),
    Object(0x6502, 0, "Supported drive modes", "u32", "const", SUPPORTED_MODES),
)  # fmt: skip

TABLE: tuple[Object | Group, ...] = COMMUNICATION + VENDOR + DRIVE

ENCODER_INCREMENTS = 1 << 20
"""Encoder increments per motor revolution."""

PEAK_TO_RATED = 2.1
"""Ratio of the arm's joint torque limit to the motor's rated torque at the joint."""

FOLLOWING_ERROR_RAD = np.radians(5.0)
POSITION_WINDOW_RAD = np.radians(0.02)

PROFILE_SHARE = 0.25
"""Default speed and acceleration of point-to-point motions, as a share of the joint's maximum."""

SERIALS = 402_000
"""Serial number to which the number of the joint (from 1) is added."""


def variables() -> Iterator[Object]:
    """Yield all variables, including the members of groups."""
    for part in TABLE:
        yield from part.members if isinstance(part, Group) else (part,)


@cache
def by_key() -> Mapping[int, Object]:
    """Return all variables by their key in `Registers`."""
    return {entry.key: entry for entry in variables()}


@cache
def indices() -> frozenset[int]:
    """Return the indices of all objects in the dictionary."""
    return frozenset(part.index for part in TABLE)


def registers_of(arm: ArmDescription, joint: int) -> Registers:
    """Return the values of all objects of a joint's drive after power-on; joints count from 0.

    The following values depend on the joint: 2^20 increments per motor revolution (608Fh), gear in
    6091h, rated torque = effort_max / gear / 2.1 [mN·m], rated current = rated torque / (drive_gain
    / gear) [mA], limits 607Dh from q_min and q_max, velocity in increments/s. The COB-IDs do not
    include the node id, which the node adds.
    """
    registers = {
        entry.key: raw_of(entry, entry.default) for entry in variables() if entry.type in CODES
    }
    return registers | _axis(arm, joint)


def _axis(arm: ArmDescription, joint: int) -> Registers:
    """Return the values of the objects that depend on the joint."""
    scale = increments_per_rad(arm, joint)
    gear = float(arm.gear_ratio[joint])
    rated_nm = float(arm.effort_max[joint]) / gear / PEAK_TO_RATED
    rated_a = rated_nm / (float(arm.drive_gains[joint]) / gear)
    speed, acceleration = float(arm.qd_max[joint]), round(arm.qdd_max[joint] * scale)
    return {
        key(0x1018, 4): SERIALS + joint + 1,
        keys.FOLLOWING_ERROR_WINDOW: round(FOLLOWING_ERROR_RAD * scale),
        keys.POSITION_WINDOW: round(POSITION_WINDOW_RAD * scale),
        keys.RATED_CURRENT: round(1000 * rated_a),
        keys.RATED_TORQUE: round(1000 * rated_nm),
        keys.POSITION_LIMIT_MIN: int(np.ceil(arm.q_min[joint] * scale)),
        keys.POSITION_LIMIT_MAX: int(np.floor(arm.q_max[joint] * scale)),
        keys.MAX_PROFILE_VELOCITY: round(speed * scale),
        keys.MAX_MOTOR_SPEED: round(speed * gear * 60 / (2 * np.pi)),
        keys.PROFILE_VELOCITY: round(PROFILE_SHARE * speed * scale),
        keys.PROFILE_ACCELERATION: round(PROFILE_SHARE * acceleration),
        keys.PROFILE_DECELERATION: round(PROFILE_SHARE * acceleration),
        keys.QUICK_STOP_DECELERATION: acceleration,
        keys.GEAR_MOTOR: round(gear),
        key(0x6092, 1): ENCODER_INCREMENTS * round(gear),
        keys.HOMING_ACCELERATION: round(PROFILE_SHARE * acceleration),
        keys.MAX_ACCELERATION: acceleration,
        keys.MAX_DECELERATION: acceleration,
    }


def raw_of(entry: Object, value: object) -> int:
    """Return the raw integer with which `Registers` stores a number."""
    assert isinstance(value, int | float)
    return raw_real(value) if entry.type == "f32" else int(value)


def increments_per_rad(arm: ArmDescription, joint: int) -> float:
    """Return the motor's encoder increments per radian of the joint."""
    return float(ENCODER_INCREMENTS * arm.gear_ratio[joint] / (2 * np.pi))


DATA_TYPES = {
    "i8": datatypes.INTEGER8,
    "u8": datatypes.UNSIGNED8,
    "i16": datatypes.INTEGER16,
    "u16": datatypes.UNSIGNED16,
    "i32": datatypes.INTEGER32,
    "u32": datatypes.UNSIGNED32,
    "f32": datatypes.REAL32,
    "text": datatypes.VISIBLE_STRING,
    "domain": datatypes.DOMAIN,
}

BIT_RATES = (125_000, 250_000, 500_000, 1_000_000)


def object_dictionary(node_id: int, registers: Registers) -> canopen.ObjectDictionary:
    """Return the dictionary of one drive, with the present registers as defaults.

    Args:
        node_id: Node id, 1 to 127.
        registers: Registers from `registers_of`, with COB-IDs without the node id.
    """
    dictionary: canopen.ObjectDictionary = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    dictionary.node_id = node_id
    device = dictionary.device_information
    device.vendor_name, device.vendor_number = "none", 0
    device.product_name, device.product_number = "HIL mock drive", 0x402
    device.revision_number = 0x0001_0000
    device.simple_boot_up_slave = True
    vars(device).update(nr_of_RXPDO=N_PDOS, nr_of_TXPDO=N_PDOS)
    device.allowed_baudrates = set(BIT_RATES)
    for part in TABLE:
        dictionary.add_object(_group(part, node_id, registers) if isinstance(part, Group)
                              else _variable(part, node_id, registers))  # fmt: skip
    return dictionary


def _group(part: Group, node_id: int, registers: Registers) -> ODArray | ODRecord:
    made = (ODArray if part.array else ODRecord)(part.name, part.index)
    for member in part.members:
        made.add_member(_variable(member, node_id, registers))
    return made


_ASCII = str.maketrans({"‰": "1/1000", "µ": "u", "·": "*", "²": "^2", "°": "deg "})


def _variable(entry: Object, node_id: int, registers: Registers) -> ODVariable:
    made = ODVariable(entry.name, entry.index, entry.sub)
    made.data_type, made.access_type = DATA_TYPES[entry.type], entry.access
    made.pdo_mappable, made.relative = entry.mappable, entry.node_relative
    made.min, made.max = entry.low, entry.high
    made.unit = entry.unit.translate(_ASCII)
    made.description = entry.note.translate(_ASCII).replace(";", ",")
    made.default = _default(entry, node_id, registers)
    if entry.type in CODES:
        vars(made)["default_raw"] = _written(entry, registers[entry.key])
    return made


def _default(entry: Object, node_id: int, registers: Registers) -> Any:
    if entry.type not in CODES:
        return entry.default if entry.type == "text" else None
    raw = registers[entry.key] + node_id * entry.node_relative
    return real(raw) if entry.type == "f32" else raw


def _written(entry: Object, raw: int) -> str:
    """Return a value in EDS notation, because the library cannot read its own negative numbers."""
    if entry.node_relative:
        return f"$NODEID+0x{raw:X}"
    if entry.type == "f32":
        return str(real(raw))
    return f"0x{raw:X}" if raw >= 0 else str(raw)


_DATES = {
    "CreationDate": "01-01-2026", "CreationTime": "12:00AM",
    "ModificationDate": "01-01-2026", "ModificationTime": "12:00AM", "EDSVersion": "4.0",
}  # fmt: skip
"""Fixed dates for EDS files, so that equal dictionaries give equal files."""


def eds_of(dictionary: canopen.ObjectDictionary) -> bytes:
    """Return an EDS file for the dictionary of one drive, as ASCII bytes."""
    from canopen.objectdictionary.eds import export_eds

    text = io.StringIO()
    with warnings.catch_warnings():
        # The library uses a time function that is deprecated since Python 3.12.
        warnings.simplefilter("ignore", DeprecationWarning)
        export_eds(dictionary, text, dict(_DATES))  # type: ignore[no-untyped-call]
    return text.getvalue().encode("ascii")
