"""Which bus the drives are on: the option `bus`."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from hil.can import runtime_folder, socket_path
from hil.core import PluginError, SpecError
from hil_drivers.cia402 import option_checks as must

BITRATES = (10_000, 1_000_000)
"""Classic CAN [bit/s]."""
SIMULATED_BITRATES = (10_000, 10_000_000)
"""No wire has so much: it says that the computer alone is to be the limit."""

BITRATE = 1_000_000

SIMULATED = ("hil_unix", "virtual")
"""Interfaces of python-can on which time may run faster than on the wall."""


@dataclass(frozen=True, slots=True)
class Bus:
    """Which bus.

    Attributes:
        interface: Of python-can.
        channel: Of that interface: `can0`, a path, a number.
        bitrate: Bits per second of classic CAN [bit/s].
    """

    interface: str
    channel: str
    bitrate: int = BITRATE

    def __str__(self) -> str:
        return f"{self.interface} {self.channel}"

    @property
    def real(self) -> bool:
        """Whether drives outside this computer may be on it."""
        vcan = self.interface == "socketcan" and re.fullmatch(r"vcan\d+", self.channel)
        return not (vcan or self.interface in SIMULATED)


def bus_of(value: Any) -> Bus:
    """The bus of a station's mapping; raises `SpecError`."""
    if value is None:
        raise SpecError(
            "the driver cia402 lacks its option bus",
            hint="say where the drives are, as in bus: {interface: socketcan, channel: can0, "
            "bitrate: 1000000}",
        )
    given = must.mapping_of("bus", value)
    must.require_known(given, [each.name for each in fields(Bus)], "bus")
    lacking = [name for name in ("interface", "channel") if given.get(name) is None]
    if lacking:
        raise must.wrong_option("bus", dict(given), f"give {', '.join(lacking)} too")
    interface = _interface(given["interface"])
    range_ = SIMULATED_BITRATES if interface in SIMULATED else BITRATES
    rate = must.number("bus.bitrate", given.get("bitrate", BITRATE), range_, whole=True)
    return Bus(interface, _channel(interface, given["channel"]), int(rate))


def _channel(interface: str, value: Any) -> str:
    """One way of writing it: two stations that mean one bus must say the same."""
    channel = must.text("bus.channel", str(value) if isinstance(value, int) else value)
    if ".." in Path(channel).parts:
        raise must.wrong_option("bus.channel", value, "name it, or give its path without ..")
    if interface != "hil_unix":
        return channel
    try:
        path = socket_path(channel)
    except PluginError as error:
        raise must.wrong_option("bus.channel", value, error.hint or error.message) from error
    return path.stem if path.parent == runtime_folder() and path.suffix == ".sock" else str(path)


def _interface(value: Any) -> str:
    """Known to python-can, its plug-ins among them; any text where that is not installed."""
    try:
        from can.interfaces import VALID_INTERFACES
    except ImportError:  # joining the bus says what to install
        return must.text("bus.interface", value)
    return str(must.choice("bus.interface", value, sorted(VALID_INTERFACES)))
