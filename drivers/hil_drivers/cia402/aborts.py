"""Why a drive aborts an SDO transfer, in words (CiA 301, and what is common among drives)."""

from __future__ import annotations

from hil.core import CommandRefused

NO_OBJECT, NO_SUB_INDEX = 0x0602_0000, 0x0609_0011
READ_ONLY, UNSUPPORTED_ACCESS = 0x0601_0002, 0x0601_0000
NOT_MAPPABLE, MAPPING_TOO_LONG, INCOMPATIBLE = 0x0604_0041, 0x0604_0042, 0x0604_0043

NOT_THERE = frozenset({NO_OBJECT, NO_SUB_INDEX})
"""The drive has no such object."""

NOT_TO_WRITE = frozenset({UNSUPPORTED_ACCESS, READ_ONLY})
"""The object is as it is."""

TEXTS = {
    0x0503_0000: "toggle bit has not alternated",
    0x0504_0000: "time-out of the transfer",
    0x0504_0001: "unknown SDO command",
    0x0504_0002: "wrong block size",
    0x0504_0003: "wrong sequence number",
    0x0504_0004: "wrong check sum",
    0x0504_0005: "out of memory",
    UNSUPPORTED_ACCESS: "no such access to this object",
    0x0601_0001: "write-only",
    READ_ONLY: "read-only",
    NO_OBJECT: "no such object",
    NOT_MAPPABLE: "cannot be mapped into a PDO",
    MAPPING_TOO_LONG: "the PDO would get longer than eight bytes, or have too many entries",
    INCOMPATIBLE: "parameters that do not go together",
    0x0604_0047: "incompatible inside the device",
    0x0606_0000: "hardware error",
    0x0607_0010: "wrong length",
    0x0607_0012: "too long",
    0x0607_0013: "too short",
    NO_SUB_INDEX: "no such sub-index",
    0x0609_0030: "value out of range",
    0x0609_0031: "value too large",
    0x0609_0032: "value too small",
    0x0609_0036: "maximum below minimum",
    0x060A_0023: "resource not available",
    0x0800_0000: "general error",
    0x0800_0020: "cannot be transferred or stored",
    0x0800_0021: "not while the device is under local control",
    0x0800_0022: "not in this state of the device",
    0x0800_0023: "no object dictionary",
    0x0800_0024: "no data",
}


class Aborted(CommandRefused):
    """A drive has aborted an SDO transfer.

    Args:
        message: Which drive, which object.
        code: Abort code.
        hint: See `HilError`.

    Attributes:
        code: The same.
    """

    def __init__(self, message: str, code: int, *, hint: str = "") -> None:
        super().__init__(f"{message}: {abort_text(code)}", hint=hint)
        self.code = code


def abort_text(code: int) -> str:
    """An abort code in words, with its number as manuals write it."""
    number = f"abort {code >> 16:04X} {code & 0xFFFF:04X}h"
    return f"{TEXTS[code]} ({number})" if code in TEXTS else number
