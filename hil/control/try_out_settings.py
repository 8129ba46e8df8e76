"""What a trial is made with when nobody says otherwise; light, for the command line reads it."""

from __future__ import annotations

RATE_HZ = 1000.0
"""Of the controller."""

FRICTION_SHARE = 0.7
"""Of the dry friction, compensated while a hand leads. `HandGuiding` by itself takes less: without
the filter below 0.7 does not always come to rest."""

SPEED_HZ = 10.0
"""Cutoff of the velocity that tells the direction of friction."""

SEEDS_APART = 900_000
"""Trials count their seeds from here, where experiments of people are not."""

MOST_SEED = 2**32 - 1 - SEEDS_APART

HALF = 0.5
"""Of the effort of the hand with the drives off: what may be left with compensation."""
