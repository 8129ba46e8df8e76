"""Joining the bus that a station names."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from hil.core import PluginError, RobotConnectionError
from hil_drivers.cia402.bus_options import Bus

if TYPE_CHECKING:
    import can

STARTING_S = 10.0
"""How long a bus between processes is waited for: `hil mock can &` may still be starting [s]."""

AGAIN_S = 0.1

_HINTS = {
    "hil_unix": "start the mock drives in another terminal first: hil mock can",
    "socketcan": "is the interface up? ip link set can0 up txqueuelen 100 type can bitrate 1000000",
}
_HINT = "is the adapter plugged in, its driver installed, and nobody else using it?"


def open_bus(bus: Bus, *, within_s: float = STARTING_S) -> can.BusABC:
    """One end of the bus, of `python-can`; shut it down when done.

    Args:
        bus: Which.
        within_s: How long to wait for the host of a bus between processes [s].

    Raises:
        RobotConnectionError: There is no such bus, or its adapter is not there.
        PluginError: `python-can` or the adapter's own package is not installed.
    """
    until = time.monotonic() + within_s
    while True:
        try:
            return _opened(bus)
        except RobotConnectionError:
            # An adapter that is not there now will not be there in a moment either.
            if bus.interface != "hil_unix" or time.monotonic() >= until:
                raise
        time.sleep(AGAIN_S)


def _opened(bus: Bus) -> can.BusABC:
    try:
        import can

        return can.Bus(interface=bus.interface, channel=bus.channel, bitrate=bus.bitrate)
    except ImportError as error:
        raise PluginError(
            f"the bus {bus.interface} needs a package that is not installed: {error}",
            hint='pip install "hil[can]", and what python-can asks for with this adapter',
        ) from error
    except (can.CanError, OSError, ValueError, TypeError) as error:
        said = str(error).splitlines()[0]
        raise RobotConnectionError(
            f"the CAN bus {bus.interface} {bus.channel} cannot be joined: {said}",
            hint=_HINTS.get(bus.interface, _HINT),
        ) from error
