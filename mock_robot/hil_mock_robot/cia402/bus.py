"""The way to a bus: one that the mock hosts, or one of python-can that is there."""

from __future__ import annotations

import math

from hil.core import SpecError
from hil_mock_robot.cia402.ends import HOSTED, BusEnd, HubEnd


def end_of(
    interface: str, channel: str, bitrate: float | None = None, wire_speed: float | None = None
) -> BusEnd:
    """The drives' end of a bus.

    Args:
        interface: `hil_unix`, or an interface of python-can.
        channel: Its channel.
        bitrate: Of the bus; on `hil_unix`, what the modelled wire has.
        wire_speed: Seconds of the modelled wire in one second; 1 when None.

    Raises:
        PluginError: There is no such bus here.
        SpecError: There is no wire that could be so fast or slow.
    """
    _require_wire(interface, bitrate, wire_speed)
    if interface == HOSTED:
        return HubEnd(channel, bitrate, wire_speed or 1.0)
    from hil_mock_robot.cia402.python_can_end import open_end

    return open_end(interface, channel, bitrate)


def _require_wire(interface: str, bitrate: float | None, speed: float | None) -> None:
    if bitrate is not None and not 0 < bitrate < math.inf:
        raise SpecError(f"--bitrate is {bitrate:g}", hint="give bits per second, such as 1000000")
    if speed is None:
        return
    if interface != HOSTED or bitrate is None:
        raise SpecError(
            f"--wire-speed {speed:g}: no wire is modelled on {interface}"
            + ("" if bitrate is None else ", it has its own"),
            hint=f"give --bitrate as well, on {HOSTED}",
        )
    if not 0 < speed < math.inf:
        raise SpecError(f"--wire-speed is {speed:g}", hint="give what the master has as its pace")
