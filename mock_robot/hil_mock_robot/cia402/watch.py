"""What an enabled drive looks at on its own: following error, speed, temperature."""

from __future__ import annotations

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Axis
from hil_mock_robot.cia402.contracts import Measured

WARM_C, HOT_C = 80.0, 110.0
OVERSPEED = 1.3
"""Of the joint's highest speed."""

SYNC_LOST_STEPS = 100
"""Device time without SYNC that a cyclic mode survives."""

NO_WINDOW = 0xFFFF_FFFF
TOO_HOT, TOO_FAST, TOO_FAR = 0x4310, 0x8400, 0x8611

GENERIC, CURRENT, VOLTAGE, TEMPERATURE, COMMUNICATION, PROFILE, MAKER = (
    0x01, 0x02, 0x04, 0x08, 0x10, 0x20, 0x80,
)  # fmt: skip
_BY_FAMILY = {0x2: CURRENT, 0x3: VOLTAGE, 0x4: TEMPERATURE, 0x7: PROFILE, 0xF: MAKER}


def register_bits(code: int) -> int:
    """Bits of the error register (1001h) that belong to an EMCY code (CiA 301)."""
    family = code >> 12
    if family == 0x8:
        return GENERIC | (COMMUNICATION if code >> 8 in (0x81, 0x82) else PROFILE)
    return GENERIC | _BY_FAMILY.get(family, 0)


class Watch:
    """The watch on one axis.

    Attributes:
        too_far: The following error is outside its window (bit 13), or was when it tripped.
        warns: The motor is warm (bit 7).
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.too_far = self.warns = False
        self._away = 0

    def reset(self) -> None:
        """Forget what was."""
        self.too_far, self._away = False, 0

    def look(self, error: int, measured: Measured, steps: int) -> int:
        """EMCY code of what is wrong, or 0.

        Args:
            error: Following error [increments]; 0 where it does not matter.
            measured: After the last steps.
            steps: How many they were.
        """
        self.warns = measured.celsius >= WARM_C
        if measured.celsius >= HOT_C:
            return TOO_HOT
        if abs(measured.qd) > OVERSPEED * self._axis.joint.qd_max:
            return TOO_FAST
        return self._following(error, steps)

    def _following(self, error: int, steps: int) -> int:
        objects = self._axis.registers
        window = objects[keys.FOLLOWING_ERROR_WINDOW]
        self.too_far = abs(error) > window != NO_WINDOW
        if not self.too_far:
            self._away = 0
            return 0
        self._away += steps
        return TOO_FAR if self._away > objects[keys.FOLLOWING_ERROR_TIMEOUT] else 0
