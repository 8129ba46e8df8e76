"""The truth about the arm and its drives, for those who judge."""

from __future__ import annotations

from typing import Any

import numpy as np

from hil_mock_robot.cia402 import keys
from hil_mock_robot.cia402.station import Station
from hil_mock_robot.server.side_channel import listed


def truth_of(station: Station) -> dict[str, Any]:
    """Where the arm really is and what its drives do; None for what nobody knows."""
    seen, axes = station.body.seen, station.axes
    return {
        "device_time": station.clock.device_s,
        "syncs": station.clock.syncs,
        "synced": station.clock.synced,
        "segment": station.marker.segment,
        "moving": station.marker.moving,
        "q": listed(np.array([each.true_q for each in seen])),
        "qd": listed(np.array([each.true_qd for each in seen])),
        "celsius": listed(np.array([each.celsius for each in seen])),
        "speed_rad_s": float(station.body.fastest),
        "states": [axis.drive.state.name for axis in axes],
        "nmt": [axis.node.nmt.state for axis in axes],
        "modes": [axis.registers[keys.MODE_DISPLAY] for axis in axes],
        "errors": [axis.registers[keys.ERROR_CODE] for axis in axes],
        "declared_kg": station.declared.mass,
        "mounted_kg": station.mounted.mass,
    }
