"""The mode in which one drive operates: what a master wants (6060h), what it gets (6061h)."""

from __future__ import annotations

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.axis import Axis
from hil_mock_robot.cia402.contracts import Demand
from hil_mock_robot.cia402.modes import CST, CYCLIC, FOLLOWING, MODE_BITS, Mode, mode_of
from hil_mock_robot.cia402.states import MODE_BIT_12


class Operation:
    """What an axis does while it is enabled.

    Args:
        axis: Whose.

    Attributes:
        refused: Modes (6060h) that 6061h does not follow though 6502h has them (injected).
        deaf: It ignores its set-points, and says so by bit 12 (injected).
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.refused: set[int] = set()
        self.deaf = False
        self.reset()

    def reset(self) -> None:
        """No mode."""
        self._shown = self._axis.registers[keys.MODE_DISPLAY] = 0
        self._mode: Mode = mode_of(0, self._axis)

    @property
    def cyclic(self) -> bool:
        """Whether the mode needs SYNC."""
        return self._shown in CYCLIC

    @property
    def follows(self) -> bool:
        """Whether the following error is watched."""
        return self._shown in FOLLOWING

    @property
    def led_by_torque(self) -> bool:
        """Whether the joint goes where its torque leads."""
        return self._shown == CST

    @property
    def told(self) -> int:
        """Bits 10, 12 and 13 of the statusword while the axis is enabled."""
        return self._mode.bits & ~(MODE_BIT_12 * self.deaf)

    def begin(self) -> None:
        """The axis is enabled: from where its set-point is now."""
        self._mode = mode_of(self._shown, self._axis)

    def resume(self) -> None:
        """A halt is over."""
        self._mode.resume()

    def listen(self) -> None:
        """A controlword has come."""
        self._mode.listen(self.deaf)

    def follow(self, *, enabled: bool) -> None:
        """Be in the mode that is wanted, if it can be; at once where the axis is enabled."""
        wanted = self._axis.registers[keys.MODE]
        if wanted != self._shown and self._takes(wanted):
            self._shown = self._axis.registers[keys.MODE_DISPLAY] = wanted
            if enabled:
                self.begin()

    def advance(self, steps: int, synced: bool) -> Demand:
        """See `Mode`."""
        return self._mode.advance(steps, synced, self.deaf)

    def _takes(self, mode: int) -> bool:
        """Whether the mode is built, supported by 6502h, and not refused."""
        if mode not in MODE_BITS or mode in self.refused:
            return False
        return bool(self._axis.registers[keys.SUPPORTED_MODES] >> MODE_BITS[mode] & 1)
