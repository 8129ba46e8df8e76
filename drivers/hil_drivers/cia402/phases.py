"""Where all axes together are on their way from off to enabled and back."""

from __future__ import annotations

from enum import Enum


class Phase(Enum):
    """Where all axes together are."""

    OFF = "off"
    RESETTING = "resetting faults"
    MODE = "setting the mode"
    ENABLING = "enabling"
    ENABLED = "enabled"
    SWITCHING = "switching the mode"
    BRAKING = "quick stop"
    DISABLING = "switching off"


WITHIN_S = {
    Phase.RESETTING: 2.0,
    Phase.MODE: 2.0,
    Phase.ENABLING: 5.0,
    Phase.SWITCHING: 1.0,
    Phase.BRAKING: 10.0,
    Phase.DISABLING: 5.0,
}
"""How long a phase may take, by device time [s]; releasing brakes takes some of `ENABLING`."""

RUNNING = (Phase.ENABLED, Phase.SWITCHING)
"""The drives follow set-points."""

WATCHED = (Phase.MODE, Phase.ENABLING, Phase.ENABLED, Phase.SWITCHING, Phase.DISABLING)
"""Something is on, or about to be: whatever goes wrong stops all axes."""
