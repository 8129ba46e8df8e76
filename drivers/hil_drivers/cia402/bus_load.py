"""Whether a rate and a mapping fit into the bit rate of one classic CAN bus.

Counted in the worst case of bit stuffing, because a frame that has to wait is a late set-point.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from hil.can import BusLoad, bits_of, bus_load
from hil.core import SpecError
from hil_drivers.cia402.mapping import MAPPINGS, Mapping

MOST_CYCLIC = 0.80
"""Share of the bus that SYNC and process data may take, at worst."""
MOST = 0.90
"""Share that all frames may take, at worst; the rest is for EMCY, and for frames sent again."""

LEAST_HZ = 4.0
"""Slower than that (60C2h: 250 ms) nothing is led along a path."""

DRIVE_HEARTBEAT_HZ, MASTER_HEARTBEAT_HZ = 10.0, 20.0
MARKER_HZ = 10.0
"""Steps of the plan and changes of status, per second at most for long."""
SDO_HZ = 10.0
"""Requests per second beside the cycles (temperatures, error codes), each with its answer."""


@dataclass(frozen=True, slots=True)
class Load:
    """How full the bus is: 1.0 is a full one.

    Attributes:
        cyclic: By SYNC, RPDOs and TPDOs.
        beside: By heartbeats, marker and SDO.
    """

    cyclic: BusLoad
    beside: BusLoad

    @property
    def total(self) -> BusLoad:
        """By all frames."""
        return BusLoad(
            self.cyclic.nominal + self.beside.nominal, self.cyclic.worst + self.beside.worst
        )

    @property
    def fits(self) -> bool:
        """Whether the drives get their set-points in time."""
        return self.cyclic.worst <= MOST_CYCLIC and self.total.worst <= MOST

    def __str__(self) -> str:
        return f"{self.cyclic.nominal:.0%} to {self.cyclic.worst:.0%} of the bus every cycle"


def cycle_lengths(mapping: Mapping, n: int) -> list[int]:
    """Data bytes of the frames of one cycle: SYNC, RPDOs and TPDOs of n axes."""
    return [0, *(pdo.length for pdo in mapping.pdos for _ in range(n))]


def load_of(mapping: Mapping, n: int, rate_hz: float, bitrate: float) -> Load:
    """How full a bus of `bitrate` [bit/s] is with n axes at `rate_hz` cycles per second."""
    cyclic = bus_load(cycle_lengths(mapping, n), rate_hz, bitrate)
    beats = bus_load([1], n * DRIVE_HEARTBEAT_HZ + MASTER_HEARTBEAT_HZ, bitrate)
    marker = bus_load([6], MARKER_HZ, bitrate)
    sdo = bus_load([8, 8], SDO_HZ, bitrate)
    beside = (beats, marker, sdo)
    return Load(cyclic, BusLoad(sum(b.nominal for b in beside), sum(b.worst for b in beside)))


def most_rate_hz(mapping: Mapping, n: int, bitrate: float) -> float:
    """The largest rate that fits and whose cycle lasts whole milliseconds [Hz]; 0 if none does."""
    beside = load_of(mapping, n, 0.0, bitrate).beside.worst
    room = min(MOST_CYCLIC, MOST - beside) * bitrate
    if room <= 0.0:
        return 0.0
    rate = 1000.0 / math.ceil(1000.0 * bits_of(cycle_lengths(mapping, n)).worst / room)
    return rate if rate >= LEAST_HZ else 0.0


def require_room(
    name: str, n: int, rate_hz: float, bitrate: float, allowed: Iterable[str] = ()
) -> None:
    """Refuse what does not fit.

    Args:
        name: Of the mapping.
        n: Number of axes.
        rate_hz: Cycles per second.
        bitrate: Of the bus [bit/s].
        allowed: Names of mappings that would do for the purpose, for the hint.

    Raises:
        SpecError: It says how full the bus would be, and what fits.
    """
    load = load_of(MAPPINGS[name], n, rate_hz, bitrate)
    if load.fits:
        return
    raise SpecError(
        f"{n} axes at {rate_hz:g} Hz with mapping {name} do not fit into {bitrate / 1000:g} "
        f"kbit/s: {_said(load)}",
        hint=_what_fits(name, n, rate_hz, bitrate, allowed),
    )


def _said(load: Load) -> str:
    c, t = load.cyclic, load.total
    return (
        f"SYNC and process data take {c.nominal:.0%} of the bus, {c.worst:.0%} with the worst bit "
        f"stuffing ({MOST_CYCLIC:.0%} is the most), all frames {t.worst:.0%} ({MOST:.0%})"
    )


def _what_fits(name: str, n: int, rate_hz: float, bitrate: float, allowed: Iterable[str]) -> str:
    most = most_rate_hz(MAPPINGS[name], n, bitrate)
    rate = f"rate_hz {most:.6g} is the largest that fits" if most else "no rate fits"
    smaller = [m for m in allowed if load_of(MAPPINGS[m], n, rate_hz, bitrate).fits]
    other = f"; with mapping {' or '.join(smaller)} {rate_hz:g} Hz fit" if smaller else ""
    return f"{rate}{other}; else a faster bus, or EtherCAT"
