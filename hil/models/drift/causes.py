"""Which change explains what the charts show: one cause moves the estimates of others too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from hil.core import FloatArray
from hil.models.drift.chart import Charted
from hil.models.drift.features import UNITS, Features

LEAST_KG = 0.05
"""Below this a place would be that of noise."""

MOST = 4
"""Causes named at most: what changes more is another robot."""


@dataclass(frozen=True, slots=True)
class Cause:
    """Something that has changed.

    Attributes:
        name: Feature; `load` for all of the load.
        change: Of it, in its unit; of the load its mass.
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
    # What jumped says by how much itself; the mean is for what creeps.
    jumped = bool(np.any(np.abs(chart.deviation) > chart.limit))
    left, p = (chart.deviation, chart.p) if jumped else (chart.mean, chart.p_mean)
    size = norm.isf(np.maximum(p, 1e-300) / 2)
    scale = np.abs(left) / np.maximum(size, np.finfo(np.float64).tiny)
    # What a cause does to other features is known as well as the model fits along the motion.
    scale = np.maximum(scale, probe.std)
    found: list[Cause] = []
    limit = float(norm.isf(false_alarm / len(left) / 4))
    groups = _groups(probe.names)
    while len(found) < MOST:
        over = np.abs(left) > limit * scale
        if not found:
            over |= chart.alarm
        if not over.any():
            break
        group = _best(left, scale, probe.response, [one for one in groups if over[one].any()])
        found.append(_cause(probe, group, left, chart.std, effort_unit))
        left = left - probe.response[:, group] @ left[group]
    return found


def _groups(names: Sequence[str]) -> list[list[int]]:
    """Features that are one cause: each of a joint by itself, all of the load."""
    load = [k for k, name in enumerate(names) if name.startswith("load ")]
    return [*([k] for k in range(len(names)) if k not in load), load]


def _best(
    left: FloatArray, scale: FloatArray, response: FloatArray, groups: Sequence[list[int]]
) -> list[int]:
    """The cause that, changed alone by what it shows, leaves least of all of them."""

    def rest(group: list[int]) -> float:
        return float(np.sum(((left - response[:, group] @ left[group]) / scale) ** 2))

    return min(groups, key=rest)


def _cause(
    probe: Features, group: Sequence[int], left: FloatArray, std: FloatArray, effort_unit: str
) -> Cause:
    k = group[0]
    change, error = float(left[k]), float(std[k])
    where, what = probe.names[k].rsplit(" ", 1)
    if where == "load":
        text = f"load at the flange: {change:+.2f} ± {error:.2f} kg{_place(left[list(group)])}"
        return Cause("load", change, error, UNITS[what], text)
    if what == "offset":
        text = f"offset on {where}: {change:+.3g} ± {error:.2g} {effort_unit}"
        return Cause(probe.names[k], change, error, effort_unit, text)
    # Effort is torque over gain: more effort for the same torque is less gain.
    sense = ("up" if change > 0 else "down") if what == "friction" else "off"
    word = "friction" if what == "friction" else "effort for the same torque"
    text = f"{word} {sense} on {where}: {100 * change:+.1f} ± {100 * error:.1f} %"
    return Cause(probe.names[k], change, error, UNITS[what], text)


def _place(load: FloatArray) -> str:
    """Of what was mounted or taken away; where the mass hardly changed there is none."""
    if abs(load[0]) < LEAST_KG:
        return ""
    return " at ({:.0f}, {:.0f}, {:.0f}) mm".format(*(1000.0 * load[1:] / load[0]))


def told(found: Sequence[Cause]) -> str:
    """One line."""
    return "; ".join(cause.text for cause in found) or "nothing has changed"
