"""Is the bus there? No frame is sent: drives answer only a master, and one may be at work."""

from __future__ import annotations

import socket
from pathlib import Path

from hil.can import is_up, socket_path, up_command
from hil.robot import Finding
from hil_drivers.cia402.can_channel import CanChannel

WITHIN_S = 2.0


def reached(bus: CanChannel) -> list[Finding]:
    """Whether the bus of a station is switched on, as far as that can be seen from here.

    Args:
        bus: Of the station.
    """
    where = f"{bus}"
    if bus.interface == "socketcan":
        up = is_up(bus.channel)
        if up is None:
            hint = "plug the adapter in; ip link shows the interfaces there are"
            return [Finding("bus", False, f"there is no interface {bus.channel}", hint=hint)]
        hint = up_command(bus.channel, bus.bitrate)
        return [Finding("bus", up, f"{where} is {'up' if up else 'down'}", hint=hint)]
    if bus.interface == "hil_unix":
        hosted = _is_hosted(socket_path(bus.channel))
        said = "is hosted" if hosted else "is not hosted by anybody"
        return [Finding("bus", hosted, f"{where} {said}", hint="start the mock: hil mock can")]
    return [Finding("bus", True, f"{where}: its adapter is seen only when it is opened")]


def _is_hosted(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as line:
        line.settimeout(WITHIN_S)
        try:
            line.connect(str(path))
        except OSError:
            return False
    return True
