"""Which change explains what the charts show: one cause moves the estimates of others too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from hil.drift.chart import Charted
from hil.drift.features import UNITS, Features
from hil.typing import FloatArray

MOST = 4
"""Causes named at most: what changes more is another robot."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Something that has changed.

    Attributes:
        name: Feature.
        change: Of it, in its unit.
        std: How sure.
        unit: `1` for a share.
        text: For people.
    """

    name: str
    change: float
    std: float
    unit: str
    text: str

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "name": self.name, "change": self.change, "std": self.std, "unit": self.unit,
            "text": self.text,
        }  # fmt: skip


def causes(probe: Features, chart: Charted, false_alarm: float, effort_unit: str) -> list[Cause]:
    """Named greedily: the cause that explains most, then what is left without it.

    Args:
        probe: The newest.
        chart: That says it is changed.
        false_alarm: As it was charted with.
        effort_unit: Of offsets.
    """
    if not chart.alarm.any():
        return []
    mean = chart.p_mean < chart.p
    left = np.where(mean, chart.mean, chart.deviation)
    # A deviation of its own size whichever chart says so: p values made comparable as normal ones.
    size = norm.isf(np.maximum(np.minimum(chart.p, chart.p_mean), 1e-300) / 2)
    scale = np.abs(left) / np.maximum(size, np.finfo(np.float64).tiny)
    found: list[Cause] = []
    limit = float(norm.isf(false_alarm / len(left) / 4))
    while len(found) < MOST:
        z = np.abs(left) / scale
        if not np.max(z) > limit:
            break
        k = _best(left, scale, probe.response, z > limit)
        found.append(_cause(probe.names[k], float(left[k]), float(chart.std[k]), effort_unit))
        left = left - probe.response[:, k] * left[k]
    return found


def _best(left: FloatArray, scale: FloatArray, response: FloatArray, over: FloatArray) -> int:
    """The feature that, changed alone by what it shows, leaves least of all of them."""
    rest = [
        float(np.sum(((left - response[:, k] * left[k]) / scale) ** 2)) if over[k] else np.inf
        for k in range(len(left))
    ]
    return int(np.argmin(rest))


def _cause(name: str, change: float, std: float, effort_unit: str) -> Cause:
    where, what = name.rsplit(" ", 1)
    unit = effort_unit if what == "offset" else UNITS[what]
    if what in ("friction", "gain"):
        # Effort is torque over gain: more effort for the same torque is less gain.
        sense = ("up" if change > 0 else "down") if what == "friction" else "off"
        word = "friction" if what == "friction" else "effort for the same torque"
        share = f"{100 * change:+.1f} ± {100 * std:.1f} %"
        return Cause(name, change, std, unit, f"{word} {sense} on {where}: {share}")
    text = f"{'load at the flange' if where == 'load' else f'offset on {where}'}"
    text += f" ({what})" if where == "load" else ""
    return Cause(name, change, std, unit, f"{text}: {change:+.3g} ± {std:.2g} {unit}")


def told(found: Sequence[Cause]) -> str:
    """One line."""
    return "; ".join(cause.text for cause in found) or "nothing has changed"
