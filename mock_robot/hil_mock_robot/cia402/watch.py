"""What an enabled drive looks at on its own: following error, speed, temperature."""

from __future__ import annotations

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Axis
from hil_mock_robot.cia402.contracts import Measured
from hil_mock_robot.cia402.states import MODE_BIT_13, WARNING

WARM_C, HOT_C = 80.0, 110.0
OVERSPEED = 1.3
"""Of the joint's highest speed."""

NO_WINDOW = 0xFFFF_FFFF
LEAST_SLIP_RAD, MOST_SLIP = 0.2, 1 << 30
TOO_HOT, TOO_FAST, TOO_FAR = 0x4310, 0x8400, 0x8611


class Watch:
    """The watch on one axis.

    Attributes:
        too_far: The following error is outside its window (bit 13), or was when it tripped.
        warns: The motor is warm (bit 7).
        hot: It is too hot.
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.too_far = self.warns = self.hot = False
        self._away = 0

    @property
    def told(self) -> int:
        """Bits 7 and 13 of the statusword."""
        return WARNING * self.warns | MODE_BIT_13 * self.too_far

    def reset(self) -> None:
        """Forget what was."""
        self.too_far, self._away = False, 0

    def slip(self) -> None:
        """The set-point jumps out of the window around the joint (injected)."""
        axis = self._axis
        window, least = axis.registers[keys.FOLLOWING_ERROR_WINDOW], LEAST_SLIP_RAD * axis.counts
        far = 0 if window == NO_WINDOW else min(2 * window, MOST_SLIP)
        axis.slipped = max(round(abs(least)), far)
        self.too_far = True

    def feel(self, celsius: float) -> None:
        """The motor is so warm [°C], whether it has power or not."""
        self.warns, self.hot = celsius >= WARM_C, celsius >= HOT_C

    def look(self, error: int, measured: Measured, steps: int) -> int:
        """EMCY code of what is wrong with an axis that has power, or 0.

        Args:
            error: Following error [increments]; 0 where it does not matter.
            measured: After the last steps.
            steps: How many they were.
        """
        if self.hot:
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
