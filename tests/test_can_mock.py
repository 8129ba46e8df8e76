"""The mock drives together: station, loop, faults and journal, in a thread on a virtual bus."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager

import can
import numpy as np
import pytest
from can_master import Abort, Master

from hil.arms import load_arm
from hil.errors import CommandRefused, PluginError, SpecError
from hil_mock_robot.cia402.hosted import HostedMock, mock_on_virtual_bus
from hil_mock_robot.journal import read_journal

PATIENT = 10.0
"""Wall time without SYNC that changes nothing: results do not depend on how busy we are."""
ARM = load_arm("lab6")
COUNTS = ARM.gear_ratio * 2**20 / (2 * math.pi)
ENABLE = 0x0F
_numbers = itertools.count(1)


@contextmanager
def mock(**options: object) -> Iterator[tuple[HostedMock, Master]]:
    channel = f"can-mock-{next(_numbers)}"
    options = {"patience_s": PATIENT, **options}
    with mock_on_virtual_bus(channel, **options) as drives:  # type: ignore[arg-type]
        with can.Bus(interface="virtual", channel=channel) as bus:
            yield drives, Master(bus)


def follow(master: Master, start: list[int], end_rad: float, cycles: int) -> None:
    """All axes by a cosine to `end_rad` from where they are."""
    for k in range(1, cycles + 1):
        way = end_rad * (1 - math.cos(math.pi * k / cycles)) / 2
        assert master.cycle(
            ENABLE, [s + round(way * c) for s, c in zip(start, COUNTS, strict=True)]
        )


def test_six_axes_follow_set_points_by_sync() -> None:
    with mock() as (drives, master):
        master.map()
        held = master.enable()
        before = drives.tell("state")
        follow(master, held, 0.2, 200)
        for _ in range(25):
            master.cycle(ENABLE, [h + round(0.2 * c) for h, c in zip(held, COUNTS, strict=True)])
        after = drives.tell("state")
        assert np.subtract(after["q"], before["q"]) == pytest.approx([0.2] * 6, abs=2e-3)
        assert after["device_time"] - before["device_time"] == pytest.approx(225 * 0.004)
        assert after["states"] == ["OPERATION_ENABLED"] * 6
        assert master.position == pytest.approx(
            [h + 0.2 * c for h, c in zip(held, COUNTS, strict=True)], abs=2e-3 * COUNTS.max()
        )
