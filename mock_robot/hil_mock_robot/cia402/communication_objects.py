"""Objects 1000h to 1A03h: the communication profile (CiA 301) of the mock drives."""

from __future__ import annotations

from hil_mock_robot.cia402.objects import Group, Object, group

DEVICE_TYPE = 0x0002_0192
"""Servo drive of profile 402."""

NOT_VALID, NO_RTR = 1 << 31, 1 << 30
"""Bits of a PDO's COB-ID."""

N_PDOS = 4
N_MAPPED = 8
RPDO_PARAMETERS, RPDO_MAPPING, TPDO_PARAMETERS, TPDO_MAPPING = 0x1400, 0x1600, 0x1800, 0x1A00
EVENT_DRIVEN = 255
TRANSMISSION_TYPES = (*range(241), 254, 255)
"""241 to 251 are reserved, 252 and 253 go by remote frames, which these drives do not know."""

HISTORY = 8
"""Errors kept in 1003h."""
N_CONSUMED = 2
"""Producers that 1016h can watch."""

_CONTROLWORD, _MODE, _TARGET_POSITION, _TARGET_VELOCITY = (
    0x6040_0010, 0x6060_0008, 0x607A_0020, 0x60FF_0020,
)  # fmt: skip
_STATUSWORD, _MODE_DISPLAY, _POSITION, _VELOCITY = (
    0x6041_0010, 0x6061_0008, 0x6064_0020, 0x606C_0020,
)  # fmt: skip

RPDO_DEFAULTS = (
    (_CONTROLWORD,),
    (_CONTROLWORD, _MODE),
    (_CONTROLWORD, _TARGET_POSITION),
    (_CONTROLWORD, _TARGET_VELOCITY),
)
TPDO_DEFAULTS = (
    (_STATUSWORD,),
    (_STATUSWORD, _MODE_DISPLAY),
    (_STATUSWORD, _POSITION),
    (_STATUSWORD, _VELOCITY),
)
"""Generic PDOs of CiA 402; the first of each direction is valid from the start."""


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


_IDENTITY = group(
    0x1018,
    "Identity",
    [
        Object(0, 1, "Vendor-ID", "u32", "ro", 0, note="nobody's: a simulated drive"),
        Object(0, 2, "Product code", "u32", "ro", 0x402),
        Object(0, 3, "Revision number", "u32", "ro", 0x0001_0000),
        Object(0, 4, "Serial number", "u32", "ro", 1, per_axis=True),
    ],
)

_ERRORS = Group(
    0x1003,
    "Pre-defined error field",
    (
        Object(0x1003, 0, "Number of errors", "u8", choices=(0,), note="writing 0 clears them"),
        *(
            Object(0x1003, sub, f"Error {sub}", "u32", "ro", note="code; the newest first")
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
