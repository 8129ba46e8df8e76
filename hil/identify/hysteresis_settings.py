"""What `rigid-hysteresis` takes for granted, and how its parameters are read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.dynamics import RobotModel
from hil.errors import SpecError
from hil.identify.friction.library import CORE, groups
from hil.suggest import did_you_mean
from hil.typing import FloatArray

DEFAULT_FILTERS: dict[str, Any] = {
    "unit": "hz",
    "velocity": 10.0,
    "acceleration": 10.0,
    "effort": 12.0,
}
"""An arm's motion has the same frequencies however often it is sampled. Chosen on four UR10e
trajectories, each left out in turn."""


def group_names(name: str, given: str | Sequence[str]) -> str | tuple[str, ...]:
    """`auto`, or names of groups; the core is always there and need not be named.

    Raises:
        SpecError: There is no such group.
    """
    if given == "auto":
        return "auto"
    known = groups(ripple=True, temperature=True)
    chosen = (given,) if isinstance(given, str) else tuple(given)
    for group in chosen:
        if group not in known:
            words = ["auto", *known]
            raise SpecError(
                f"{name}: there is no group {group!r}",
                hint=did_you_mean(str(group), words) or f"there are {', '.join(words)}",
            )
    return tuple(dict.fromkeys((CORE, *chosen)))


def motor_turns(robot: RobotModel, gear_ratio: float | None) -> FloatArray:
    """(n,) motor turns per joint turn; NaN where nobody knows."""
    if gear_ratio is not None:
        return np.full(robot.n, gear_ratio)
    if robot.arm is None:
        return np.full(robot.n, np.nan)
    return np.asarray(robot.arm.gear_ratio, dtype=np.float64)
