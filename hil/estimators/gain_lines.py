"""Drive gains as lines of YAML and as JSON, whichever way they were found."""

from __future__ import annotations

import numpy as np

from hil.core import FloatArray

KEPT = "as declared before"
"""Said of joints whose gain was not found."""


CALIBRATED = ("calibrated with ", "the controller's current per torque ")
"""What the sources begin with that `hil gains` writes."""


def calibrated(source: str) -> bool:
    """Whether gains of this source were all measured on the arm itself."""
    return source.startswith(CALIBRATED) and KEPT not in source


def gain_lines(
    names: tuple[str, ...],
    gain: FloatArray,
    reasons: tuple[str, ...],
    declared: FloatArray | None,
    source: str,
) -> list[str]:
    """`drive_gains_nm_a` and its source for a station or an import map.

    Args:
        names: Length n, the joints.
        gain: (n,) gains found [N·m/A].
        reasons: Length n, why a joint's gain is not determined; empty where it is.
        declared: (n,) gains that joints which were not determined keep, or None: then there are
            no lines unless all were, because a map needs a gain for every joint.
        source: Where the gains come from, in words.
    """
    other = [name for name, reason in zip(names, reasons, strict=True) if reason]
    if declared is None and other:
        return []
    kept = gain if declared is None else declared
    values = np.where([not reason for reason in reasons], gain, kept)
    source += f"; {', '.join(other)} {KEPT}" if other else ""
    told = ", ".join(f"{value:.3f}" for value in values)
    return [f"drive_gains_nm_a: [{told}]", f'drive_gains_source: "{source}"']


def listed(values: FloatArray) -> list[float | None]:
    """Numbers for JSON; what is not determined is null."""
    return [float(value) if np.isfinite(value) else None for value in values]
