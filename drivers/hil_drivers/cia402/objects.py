"""Objects of CiA 301 and CiA 402 that the driver uses, with their error and abort codes.

The module contains the objects (docs/reference/cia402-objects.md). The module also contains the
meanings of the error codes (EMCY messages, 603Fh, 1003h), of the error register (1001h), and of the
codes with which a drive aborts a request. CANopen (SDO) and EtherCAT (CoE) use the same objects,
data types and codes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from hil.core import CommandRefused


@dataclass(frozen=True, slots=True)
class Entry:
    """One variable of a drive's object dictionary.

    Attributes:
        name: Name of the object in this driver, which is also its field name in raw records.
        index: Index of the object.
        sub: Sub-index of the object.
        code: `struct` code of the data type: b, B, h, H, i or I.
        unit: Unit as text; the drive defines the size of an increment and of a part per thousand.
    """

    name: str
    index: int
    sub: int
    code: str
    unit: str = ""

    @property
    def size(self) -> int:
        """Size of the object's value in bytes."""
        return struct.calcsize("<" + self.code)

    @property
    def bits(self) -> int:
        """Length of the object's value in a PDO [bits]."""
        return 8 * self.size

    @property
    def mapped(self) -> int:
        """Mapping parameter of the object for 16xxh and 1Axxh: index, sub-index, length in bits."""
        return self.index << 16 | self.sub << 8 | self.bits

    def __str__(self) -> str:
        sub = f":{self.sub:02X}" if self.sub else ""
        return f"{self.index:04X}h{sub} ({self.name.replace('_', ' ')})"


DEVICE_TYPE = Entry("device_type", 0x1000, 0, "I")
ERROR_REGISTER = Entry("error_register", 0x1001, 0, "B")
SYNC_COB_ID = Entry("sync_cob_id", 0x1005, 0, "I")
CYCLE_PERIOD = Entry("cycle_period", 0x1006, 0, "I", "µs")
CONSUMER_HEARTBEAT = Entry("consumer_heartbeat", 0x1016, 1, "I", "node << 16 | ms")
PRODUCER_HEARTBEAT = Entry("producer_heartbeat", 0x1017, 0, "H", "ms")
VENDOR = Entry("vendor", 0x1018, 1, "I")
PRODUCT = Entry("product", 0x1018, 2, "I")
REVISION = Entry("revision", 0x1018, 3, "I")
SERIAL = Entry("serial", 0x1018, 4, "I")
ABORT_CONNECTION_OPTION = Entry("abort_connection_option", 0x6007, 0, "h")
ERROR_CODE = Entry("error_code", 0x603F, 0, "H")
CONTROLWORD = Entry("controlword", 0x6040, 0, "H")
STATUSWORD = Entry("statusword", 0x6041, 0, "H")
QUICK_STOP_OPTION = Entry("quick_stop_option", 0x605A, 0, "h")
FAULT_REACTION_OPTION = Entry("fault_reaction_option", 0x605E, 0, "h")
MODE = Entry("mode", 0x6060, 0, "b")
MODE_DISPLAY = Entry("mode_display", 0x6061, 0, "b")
POSITION = Entry("position", 0x6064, 0, "i", "increments")
FOLLOWING_ERROR_WINDOW = Entry("following_error_window", 0x6065, 0, "I", "increments")
FOLLOWING_ERROR_TIMEOUT = Entry("following_error_timeout", 0x6066, 0, "H", "ms")
VELOCITY = Entry("velocity", 0x606C, 0, "i", "increments/s unless the profile says otherwise")
TARGET_TORQUE = Entry("target_torque", 0x6071, 0, "h", "‰ of rated torque")
MAX_TORQUE = Entry("max_torque", 0x6072, 0, "H", "‰ of rated torque")
RATED_CURRENT = Entry("rated_current", 0x6075, 0, "I", "mA")
RATED_TORQUE = Entry("rated_torque", 0x6076, 0, "I", "mN·m")
TORQUE = Entry("torque", 0x6077, 0, "h", "‰ of rated torque")
CURRENT = Entry("current", 0x6078, 0, "h", "‰ of rated current")
TARGET_POSITION = Entry("target_position", 0x607A, 0, "i", "increments")
POSITION_LIMIT_MIN = Entry("position_limit_min", 0x607D, 1, "i", "increments")
POSITION_LIMIT_MAX = Entry("position_limit_max", 0x607D, 2, "i", "increments")
POLARITY = Entry("polarity", 0x607E, 0, "B")
QUICK_STOP_DECELERATION = Entry("quick_stop_deceleration", 0x6085, 0, "I", "increments/s²")
ENCODER_INCREMENTS = Entry("encoder_increments", 0x608F, 1, "I")
ENCODER_REVOLUTIONS = Entry("encoder_revolutions", 0x608F, 2, "I")
GEAR_MOTOR = Entry("gear_motor", 0x6091, 1, "I")
GEAR_SHAFT = Entry("gear_shaft", 0x6091, 2, "I")
TORQUE_OFFSET = Entry("torque_offset", 0x60B2, 0, "h", "‰ of rated torque")
INTERPOLATION_VALUE = Entry("interpolation_value", 0x60C2, 1, "B")
INTERPOLATION_INDEX = Entry("interpolation_index", 0x60C2, 2, "b")
TARGET_VELOCITY = Entry("target_velocity", 0x60FF, 0, "i", "as velocity")
SUPPORTED_MODES = Entry("supported_modes", 0x6502, 0, "I")
ERROR_COUNT = Entry("error_count", 0x1003, 0, "B")
TORQUE_SCALING = Entry("torque_scaling", 0x2002, 0x54, "I", "EL72xx: 0 peak, 1 rms current")
TORQUE_CONSTANT = Entry("torque_constant", 0x2003, 0x16, "I", "EL72xx: mN·m/A")

CSP, CSV, CST = 8, 9, 10
"""Modes of operation (6060h) that take a new set-point with every SYNC."""

MODE_BITS = {CSP: 7, CSV: 8, CST: 9}
"""Bit number of each mode of operation in the object of supported modes (6502h)."""

MODE_NAMES = {CSP: "csp", CSV: "csv", CST: "cst"}

ERRORS = {
    0x1000: "generic error",
    0x2110: "short circuit or earth fault at the input",
    0x2211: "over-current at the input",
    0x2220: "continuous over-current inside",
    0x2230: "short circuit or earth fault inside",
    0x2250: "short circuit inside",
    0x2310: "continuous over-current at the output",
    0x2320: "short circuit or earth fault at the output",
    0x2330: "earth fault at the output",
    0x2340: "short circuit at the output",
    0x2350: "I²t of the motor",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3130: "mains phase lost",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x3230: "load error",
    0x3310: "output over-voltage",
    0x4110: "ambient temperature too high",
    0x4120: "ambient temperature too low",
    0x4210: "device too hot",
    0x4220: "device too cold",
    0x4310: "drive or motor too hot",
    0x4320: "drive or motor too cold",
    0x4410: "supply too hot",
    0x5112: "24 V supply too low",
    0x5400: "power section",
    0x5441: "safe torque off, or the enable contact is open",
    0x5510: "memory",
    0x5530: "data in non-volatile memory",
    0x6010: "watchdog of the firmware",
    0x6310: "loss of parameters",
    0x6320: "wrong parameters",
    0x7110: "brake chopper",
    0x7121: "motor blocked",
    0x7122: "motor or its commutation",
    0x7180: "holding brake",
    0x7300: "sensor",
    0x7303: "resolver 1",
    0x7305: "encoder 1",
    0x7306: "encoder 2",
    0x7310: "overspeed",
    0x7320: "position sensor",
    0x7500: "communication with an internal unit",
    0x8110: "CAN frames lost (overrun)",
    0x8120: "CAN controller error passive",
    0x8130: "heartbeat of the master lost",
    0x8140: "recovered from bus-off",
    0x8150: "two nodes with one COB-ID",
    0x8210: "PDO of the wrong length, not used",
    0x8220: "PDO too long",
    0x8240: "SYNC of the wrong length",
    0x8250: "time-out of an RPDO",
    0x8311: "excess torque",
    0x8312: "difficult start-up",
    0x8313: "standstill torque",
    0x8321: "insufficient torque",
    0x8331: "torque fault",
    0x8400: "velocity controller",
    0x8480: "velocity control: error too large",
    0x8500: "position controller",
    0x8611: "following error",
    0x8612: "reference limit: set-point out of range",
    0x8700: "sync controller: SYNC or set-points came at the wrong time, or not at all",
    0x9000: "external error",
    0xF001: "deceleration",
    0xF002: "sub-synchronous run",
    0xF003: "stroke operation",
    0xF004: "control",
}
"""Error texts of single error codes."""

ERROR_RANGES = (
    (0xFFF0, 0x2310, "over-current at the output"),
    (0xFFF0, 0x3210, "DC link over-voltage"),
    (0xFFF0, 0x3220, "DC link under-voltage"),
    (0xFFF0, 0x8610, "positioning controller"),
    (0xFF00, 0x2100, "current at the input"),
    (0xFF00, 0x2200, "current inside the device"),
    (0xFF00, 0x2300, "current at the output"),
    (0xFF00, 0x3100, "mains voltage"),
    (0xFF00, 0x3200, "DC link voltage"),
    (0xFF00, 0x3300, "output voltage"),
    (0xFF00, 0x4200, "device temperature"),
    (0xFF00, 0x4300, "drive or motor temperature"),
    (0xFF00, 0x5100, "supply of the electronics"),
    (0xFF00, 0x5200, "control hardware"),
    (0xFF00, 0x6100, "firmware"),
    (0xFF00, 0x6200, "user program"),
    (0xFF00, 0x6300, "parameters"),
    (0xFF00, 0x7100, "power section or brake"),
    (0xFF00, 0x7300, "sensor"),
    (0xFF00, 0x8100, "communication"),
    (0xFF00, 0x8200, "protocol"),
    (0xFF00, 0x8300, "torque control"),
    (0xFF00, 0x8400, "velocity control"),
    (0xFF00, 0x8500, "position control"),
    (0xFF00, 0x8600, "positioning control"),
    (0xFF00, 0x8700, "synchronisation"),
    (0xFF00, 0xFF00, "vendor's own error"),
    (0xF000, 0x1000, "generic error"),
    (0xF000, 0x2000, "current"),
    (0xF000, 0x3000, "voltage"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "hardware of the device"),
    (0xF000, 0x6000, "software of the device"),
    (0xF000, 0x7000, "additional modules"),
    (0xF000, 0x8000, "monitoring"),
    (0xF000, 0x9000, "external error"),
    (0xF000, 0xF000, "additional functions"),
)
"""Error texts of ranges of error codes: mask, value of the masked code, text."""

REGISTER = (
    "generic",
    "current",
    "voltage",
    "temperature",
    "communication",
    "device profile",
    "reserved",
    "vendor's own",
)
"""Names of the bits of the error register (1001h), from bit 0."""


def error_text(code: int) -> str:
    """Return the text of an error code, with its number in the notation of manuals."""
    return f"{_error_words(code)} ({code:04X}h)"


def _error_words(code: int) -> str:
    if code == 0:
        return "no error"
    if code in ERRORS:
        return ERRORS[code]
    return next((text for mask, kept, text in ERROR_RANGES if code & mask == kept), "unknown error")


def register_text(register: int) -> str:
    """Return the set bits of the error register (1001h) as text; empty if no bit is set."""
    return ", ".join(text for bit, text in enumerate(REGISTER) if register >> bit & 1)


NO_OBJECT, NO_SUB_INDEX = 0x0602_0000, 0x0609_0011
READ_ONLY, UNSUPPORTED_ACCESS = 0x0601_0002, 0x0601_0000
NOT_MAPPABLE, MAPPING_TOO_LONG, INCOMPATIBLE = 0x0604_0041, 0x0604_0042, 0x0604_0043

NOT_THERE = frozenset({NO_OBJECT, NO_SUB_INDEX})
"""Abort codes for a request for an object that the drive does not have."""

NOT_TO_WRITE = frozenset({UNSUPPORTED_ACCESS, READ_ONLY})
"""Abort codes for a write of an object that cannot be written."""

ABORTS = {
    0x0503_0000: "toggle bit has not alternated",
    0x0504_0000: "time-out of the transfer",
    0x0504_0001: "unknown SDO command",
    0x0504_0002: "wrong block size",
    0x0504_0003: "wrong sequence number",
    0x0504_0004: "wrong check sum",
    0x0504_0005: "out of memory",
    UNSUPPORTED_ACCESS: "unsupported access to this object",
    0x0601_0001: "write-only",
    READ_ONLY: "read-only",
    NO_OBJECT: "no such object",
    NOT_MAPPABLE: "cannot be mapped into a PDO",
    MAPPING_TOO_LONG: "the PDO would exceed eight bytes or have too many entries",
    INCOMPATIBLE: "incompatible parameters",
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
    """Error raised when a drive has aborted an SDO transfer.

    Args:
        message: Text with the drive and the object of the transfer.
        code: Abort code.
        hint: See `HilError`.

    Attributes:
        code: Abort code.
    """

    def __init__(self, message: str, code: int, *, hint: str = "") -> None:
        super().__init__(f"{message}: {abort_text(code)}", hint=hint)
        self.code = code


def abort_text(code: int) -> str:
    """Return the text of an abort code, with its number in the notation of manuals."""
    number = f"abort {code >> 16:04X} {code & 0xFFFF:04X}h"
    return f"{ABORTS[code]} ({number})" if code in ABORTS else number
