"""What is said at the end of a passive recording about what it is good for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hil.core import HilError
from hil.dynamics import load_model
from hil.estimators import StaticWls
from hil.robot import Status

NOT_USABLE = Status.FAULT | Status.MASKED
"""Bits of `status` of which either says that the effort is no measurement."""


def unusable_notes(rows: int, counts: Mapping[str, int]) -> tuple[str, ...]:
    """That an arm was switched off, braked or stopped while it was recorded.

    Args:
        rows: Samples that say so.
        counts: Of the recording.
    """
    if not rows:
        return ()
    return (
        f"{rows} of {counts.get('samples', rows)} samples are of an arm that was not running "
        "(switched off, braked, or in a stop): they are kept, and not fitted to",
    )


def fit_notes(found: Mapping[str, int], robot: Mapping[str, Any]) -> tuple[str, ...]:
    """That there are fewer dwells than gravity has parameters, where there is nothing else to use.

    Args:
        found: Dwells, moves and trajectories.
        robot: Of the start document.
    """
    dwells = found.get("dwell", 0)
    need = 0 if found.get("trajectory") else dwells_needed(robot)
    if dwells >= need:
        return ()
    return (
        f"{dwells} dwells are too few for static-wls, which needs {need}: record longer, "
        "or fit to several recordings",
    )


def dwells_needed(robot: Mapping[str, Any]) -> int:
    """Return the fewest dwells that static-wls needs; 0 where the robot is unknown."""
    try:
        model = load_model(str(robot["model"]), gravity=robot["gravity_m_s2"])
    except (HilError, KeyError):
        return 0
    return StaticWls().needs(model).least["dwells"]
