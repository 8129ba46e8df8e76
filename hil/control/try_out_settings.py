"""Default settings of a control trial.

This module has no heavy imports, because the command line imports it.
"""

from __future__ import annotations

RATE_HZ = 1000.0
"""Sample rate of the controller [Hz]."""

FRICTION_SHARE = 0.7
"""Share of the dry friction that is compensated during hand guiding in a trial.

The class `HandGuiding` alone uses a lower default share: without the velocity filter of the trial,
an arm with the share 0.7 does not always come to rest.
"""

SPEED_HZ = 10.0
"""Cutoff frequency of the filter for the velocity that determines the direction of friction
[Hz]."""

SEEDS_APART = 900_000
"""Offset of the seeds of control trials, so that they differ from the seeds of experiments."""

MOST_SEED = 2**32 - 1 - SEEDS_APART

HALF = 0.5
"""Maximum allowed ratio of the hand effort with compensation to the hand effort with the drives
off."""
