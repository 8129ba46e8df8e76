"""Rows of the PLC's ring as the base robot record; how they were read as a topic of its own."""

from __future__ import annotations

import numpy as np

from hil.core import StructArray
from hil.robot import Topic, state_dtype
from hil_drivers.twincat.ring import Ring
from hil_drivers.twincat.symbols import EFFORT_TARGETS, TEMPERATURES

TOPIC = "/robot/twincat"

_FIELDS = {
    "q": "aQ", "qd": "aQd", "effort": "aEffort", "q_target": "aQTarget",
    "qd_target": "aQdTarget", "qdd_target": "aQddTarget", "segment": "nSegment",
    "status": "nStatus", "fault_code": "nFault", "mode": "nPhase",
}  # fmt: skip
"""Field of the base record ← field of a row."""

NS = 1e-9


class HostClock:
    """When rows were made by this computer's clock, spread over the time since the last block."""

    def __init__(self) -> None:
        self._device = self._host = np.nan

    def stamp(self, rows: StructArray, now: float, period_s: float) -> None:
        """Fill in `host_time`.

        Args:
            rows: (N,) state rows, N ≥ 1.
            now: Unix time at which the newest was there [s].
            period_s: Of the rows [s].
        """
        device = rows["device_time"]
        if np.isnan(self._host):
            self._device = device[0] - period_s
            self._host = now - len(rows) * period_s
        share = (device - self._device) / max(device[-1] - self._device, period_s)
        rows["host_time"] = self._host + share * (now - self._host)
        self._device, self._host = float(device[-1]), now


def state_rows(raw: StructArray, offers: int) -> StructArray:
    """Rows of the ring as the base robot record, without `host_time`.

    Args:
        raw: (N,) rows.
        offers: `nOffers`; what the PLC does not measure becomes NaN.
    """
    rows = np.zeros(len(raw), state_dtype(raw.dtype["aQ"].shape[0]))
    rows["device_time"] = raw["nTimeNs"] * NS
    for name, told in _FIELDS.items():
        rows[name] = raw[told]
    rows["temperature"] = raw["aCelsius"] if offers & TEMPERATURES else np.nan
    rows["effort_target"] = raw["aEffortTarget"] if offers & EFFORT_TARGETS else np.nan
    return rows


def reading_topic(rate_hz: float) -> Topic:
    """How the ring was read: the number of each row, and what was lost before it.

    Args:
        rate_hz: Rows per second [Hz].
    """
    fields = [
        ("device_time", "<f8"), ("host_time", "<f8"), ("sequence", "<i8"), ("gaps", "<i4"),
        ("lost", "<i4"), ("skipped", "<i4"), ("waited", "<i4"),
    ]  # fmt: skip
    units = {
        "device_time": "s", "host_time": "s (Unix time)", "sequence": "row, from 0",
        "gaps": "so far", "lost": "rows so far", "skipped": "rows so far, not wanted",
        "waited": "rows in the block",
    }  # fmt: skip
    return Topic(
        name=TOPIC,
        dtype=np.dtype(fields),
        rate_hz=rate_hz,
        clock="controller",
        units=units,
        schema_name="hil/msg/TwinCatRow",
    )


def reading_rows(rows: StructArray, raw: StructArray, ring: Ring, topic: Topic) -> StructArray:
    """What is told of the reading of a block.

    Args:
        rows: (N,) state rows.
        raw: (N,) the same as they stood in the ring.
        ring: Which has just read them.
        topic: As `reading_topic` makes it.
    """
    told = topic.blank(len(rows))
    told["device_time"], told["host_time"] = rows["device_time"], rows["host_time"]
    told["sequence"], told["waited"] = raw["nSequence"], len(rows)
    told["gaps"], told["lost"], told["skipped"] = ring.gaps, ring.lost, ring.skipped
    return told
