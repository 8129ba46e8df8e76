"""When a dwell is over: enough settled samples, the shortest time, or the time-out."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray, StructArray
from hil.planning import DwellRule


class DwellWatch:
    """Follows one dwell block by block.

    Args:
        rule: The plan's rule.
    """

    def __init__(self, rule: DwellRule) -> None:
        self._rule = rule
        self._since: float | None = None
        self._quiet: list[bool] = []
        self._last = 0.0
        self._newest: list[StructArray] = []

    def feed(self, block: StructArray) -> bool:
        """Add samples of this dwell; True when it is over, settled or not."""
        if self._since is None:
            self._since = float(block["device_time"][0])
        speed: FloatArray = np.abs(block["qd"]).max(axis=1)
        self._quiet.extend((speed < self._rule.settle_rad_s).tolist())
        self._last = float(block["device_time"][-1])
        self._newest = [*self._newest[-self._rule.samples :], block]
        return self.settled or self.elapsed_s >= self._rule.timeout_s

    @property
    def rows(self) -> StructArray:
        """The newest rows, as many as the rule asks for (fewer when there are fewer)."""
        return np.concatenate(self._newest)[-self._rule.samples :]

    @property
    def elapsed_s(self) -> float:
        """Device time since the dwell began [s]."""
        return 0.0 if self._since is None else self._last - self._since

    @property
    def settled(self) -> bool:
        """True when the newest samples are all at rest and the shortest time is over."""
        newest = self._quiet[-self._rule.samples :]
        enough = len(newest) == self._rule.samples and all(newest)
        return enough and self.elapsed_s >= self._rule.dwell_s
