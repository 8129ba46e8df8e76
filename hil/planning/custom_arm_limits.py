"""Limits of a URDF that no arm has: none at all, or degrees where radians belong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hil.core import SpecError
from hil.dynamics import Described

MOST_RAD = 4 * np.pi
"""Two turns to either side; arms with more turn endlessly."""
MOST_RAD_S = 50.0
"""Eight turns a second, far above any arm's joint: degrees, or a number that stands for none."""


def require_ranges(urdf: Path, found: Described) -> None:
    """Refuse joints that cannot move, or that turn so far that their limits must be degrees.

    Raises:
        SpecError: With a line for each such joint.
    """
    ranges = [*zip(found.joint_names, found.q_min, found.q_max, strict=True)]
    stuck = [f"joint '{name}' has no range ({a:g} to {b:g})" for name, a, b in ranges if a >= b]
    far = [
        f"joint '{name}' turns from {a:g} to {b:g} rad, {(b - a) / (2 * np.pi):.0f} turns; are its "
        "limits in degrees?"
        for name, a, b in ranges
        if np.isfinite(b - a) and max(-a, b) > MOST_RAD
    ]
    if stuck:
        hint = (
            "give its <limit> `lower` and `upper` in radians, or make it of type fixed or, "
            "if it turns endlessly, continuous"
        )
    else:
        hint = (
            "a URDF has radians: 150° is 2.618 (and `velocity` has rad/s); a joint that turns "
            "endlessly is of type continuous"
        )
    if stuck or far:
        raise SpecError("\n".join(f"{urdf}: {line}" for line in stuck + far), hint=hint)


def without_odd_speeds(found: Described) -> tuple[Described, list[str]]:
    """The arm without speed limits that none has, and a line for people where it had some."""
    odd = np.flatnonzero(found.qd_max > MOST_RAD_S)
    if not len(odd):
        return found, []
    told = ", ".join(f"{found.joint_names[j]} {found.qd_max[j]:g} rad/s" for j in odd)
    kept = np.where(found.qd_max > MOST_RAD_S, 0.0, found.qd_max)
    return replace(found, qd_max=kept), [
        f"speed limits that no arm has (are they degrees per second?): {told}: not taken"
    ]
