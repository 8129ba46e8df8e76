"""Why an SDO transfer is aborted (CiA 301)."""

from __future__ import annotations

from canopen import SdoAbortedError

WRITE_ONLY = 0x0601_0001
READ_ONLY = 0x0601_0002
NO_OBJECT = 0x0602_0000
NOT_MAPPABLE = 0x0604_0041
PDO_TOO_LONG = 0x0604_0042
INCOMPATIBLE = 0x0604_0043
WRONG_LENGTH = 0x0607_0010
NO_SUB_INDEX = 0x0609_0011
OUT_OF_RANGE = 0x0609_0030
DEVICE_STATE = 0x0800_0022
NO_DATA = 0x0800_0024

Abort = SdoAbortedError
"""Raised with one of the codes; the SDO server answers with it."""


def require(condition: bool, code: int) -> None:
    """Abort with this code unless the condition holds."""
    if not condition:
        raise Abort(code)
