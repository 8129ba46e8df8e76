"""What is allowed and still worth a second look before a robot is kept busy with it."""

from __future__ import annotations

import math
from collections.abc import Iterator

HIGHEST_CONDITION = 1000.0
"""Of the column-scaled regressor; noise then reaches some parameters a thousandfold."""

LONGEST_S = 12 * 3600.0

LARGEST_BYTES = 20e9


def concerns(condition_number: float, duration_s: float, recording_bytes: float) -> Iterator[str]:
    """One sentence for everything about a plan that is allowed but hardly meant.

    Args:
        condition_number: See `hil.planning.quality`; infinite when parameters are not determined.
        duration_s: Estimated duration [s].
        recording_bytes: Estimated size of the recording.
    """
    if math.isinf(condition_number):
        yield (
            "the motion does not tell all parameters apart (infinite condition number): a fit "
            "will be refused; plan more poses or trajectories, or larger ranges"
        )
    elif condition_number > HIGHEST_CONDITION:
        yield (
            f"the condition number is {condition_number:.0f}, above {HIGHEST_CONDITION:.0f}: some "
            "parameters will be mostly noise; plan more poses or trajectories, or larger ranges"
        )
    if duration_s > LONGEST_S:
        yield f"the program takes {duration_s / 3600:.1f} h, more than {LONGEST_S / 3600:.0f} h"
    if recording_bytes > LARGEST_BYTES:
        yield (
            f"the recording takes about {recording_bytes / 1e9:.0f} GB, more than "
            f"{LARGEST_BYTES / 1e9:.0f} GB"
        )
