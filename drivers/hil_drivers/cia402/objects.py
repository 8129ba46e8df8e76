"""The objects of CiA 301 and CiA 402 that the driver reads and writes (docs: cia402-objects)."""

from __future__ import annotations

import struct
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Entry:
    """One variable of the object dictionary.

    Attributes:
        name: Ours, also the field of raw records.
        index, sub: Where it is.
        code: `struct` code of its type: b B h H i I.
        unit: In words; increments and parts per thousand are the drive's own.
    """

    name: str
    index: int
    sub: int
    code: str
    unit: str = ""

    @property
    def size(self) -> int:
        """Bytes."""
        return struct.calcsize("<" + self.code)

    @property
    def bits(self) -> int:
        """Length in a PDO."""
        return 8 * self.size

    @property
    def mapped(self) -> int:
        """What 16xxh and 1Axxh hold for it: index, sub-index, length in bits."""
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
"""Their bits in 6502h."""
MODE_NAMES = {CSP: "csp", CSV: "csv", CST: "cst"}
