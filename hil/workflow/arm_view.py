"""How the arm is at one moment: its joints, and how far every interlock is from its limit."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from hil.core import StructArray
from hil.engine import HasMargin, Interlock
from hil.robot import Capabilities, Status

FIELDS = {
    "q_rad": "q",
    "qd_rad_s": "qd",
    "effort": "effort",
    "temperature_c": "temperature",
    "q_target_rad": "q_target",
}
"""Key in the view → field of the state record."""


class ArmView:
    """What people are shown of an arm that is being read; judges nothing.

    Args:
        robot: Joint names and the unit of efforts.
        interlocks: What watches over the run.
    """

    def __init__(self, robot: Capabilities, interlocks: Iterable[Interlock]) -> None:
        self._names = list(robot.joint_names)
        self._clock = robot.clock
        self._unit = "A" if robot.effort_kind == "current" else "N·m"
        self._watching = [one for one in interlocks if isinstance(one, HasMargin)]

    def of(self, rows: StructArray) -> dict[str, Any]:
        """The last of some state rows, as `arm` and `interlocks` of the live view.

        An interlock that cannot tell its margin is left out; what it does is its own affair.
        """
        row = rows[-1]
        arm = {
            "device_time_s": float(row["device_time"]),
            "joints": self._names,
            "effort_unit": self._unit,
            "clock": self._clock,
            "moving": bool(row["status"] & Status.MOVING),
            **{key: _numbers(row[field]) for key, field in FIELDS.items()},
        }
        return {"arm": arm, "interlocks": list(self._margins(rows))}

    def _margins(self, rows: StructArray) -> Iterable[dict[str, Any]]:
        for interlock in self._watching:
            try:
                margin = interlock.margin(rows)
                told = margin and {key: _rounded(value) for key, value in margin.to_dict().items()}
            except Exception:  # noqa: S112 - of a plugin, say: the others are shown
                continue
            if margin and told:
                told["subject"] = margin.subject or self._name(margin.joint)
                yield {"name": interlock.name, "action": interlock.action, **told}

    def _name(self, joint: int) -> str:
        """Of a margin that is no joint's (−1) nothing."""
        return self._names[joint] if 0 <= joint < len(self._names) else ""


def _numbers(values: Any) -> list[float | None]:
    """What is not measured is null."""
    return [_rounded(value) for value in values.tolist()]


def _rounded(value: Any) -> Any:
    """Six digits are enough to look at."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.6g}") if math.isfinite(value) else None
