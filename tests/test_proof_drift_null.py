"""A thousand probes of robots that have not changed: how many are called changed?

Twenty mock robots, a campaign and 55 probes each, in rooms from 14 to 30 °C; every probe begins
cold and warms up, by which friction falls as much as by the wear that is looked for.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from null_probes import FIRST_SEED, null_probes

from hil.drift.causes import causes
from hil.drift.chart import FALSE_ALARM, REFERENCE, charted
from hil.drift.features import Features
from hil.executor import processes

ROBOTS, PROBES = 20, 50
WORN, MORE = "shoulder_lift_joint friction", 0.05

pytestmark = [pytest.mark.proof, pytest.mark.timeout(5400)]


def called_changed(probes: list[Features], sigma: list[float], rate: float) -> list[bool]:
    """Of each probe after the reference, as `hil drift` says it when it comes."""
    quiet, told = probes[:REFERENCE], []
    for probe in probes[REFERENCE:]:
        chart = charted([*quiet, probe], np.array(sigma), rate)
        told.append(bool(chart.alarm.any()))
        quiet = quiet if told[-1] else [*quiet, probe]
    return told


def test_unchanged_robots_are_called_changed_as_rarely_as_stated(tmp_path: Path) -> None:
    seeds = range(FIRST_SEED, FIRST_SEED + ROBOTS)
    with processes(2) as pool:
        waiting = [pool.submit(null_probes, seed, PROBES, tmp_path) for seed in seeds]
        taken = [one.result() for one in waiting]
    alarms = [sum(called_changed(*one, FALSE_ALARM)) for one in taken]
    total = ROBOTS * PROBES
    print(f"{sum(alarms)} of {total} null probes called changed, stated {FALSE_ALARM:.0%}")  # noqa: T201
    print(f"alarms of each robot: {alarms}")  # noqa: T201
    # Each chart gets its share of the rate as if it stood alone, so that fewer are to be expected.
    assert sum(alarms) <= 1.5 * FALSE_ALARM * total
    # Charts that never call anything would pass the line above.
    found = [probe for one in taken for probe in more_friction(*one)]
    print(f"{sum(found)} of {len(found)} probes with {MORE:.0%} more friction found and named")  # noqa: T201
    assert sum(found) >= 0.95 * len(found)


def more_friction(probes: list[Features], sigma: list[float]) -> list[bool]:
    """Whether each probe, taken as the first after J2 got a little stiffer, is named as that."""
    reference, told = probes[:REFERENCE], []
    k = probes[0].names.index(WORN)
    for probe in probes[REFERENCE:]:
        worn = replace(probe, values=probe.values + MORE * probe.response[:, k])
        chart = charted([*reference, worn], np.array(sigma))
        named = causes(worn, chart, FALSE_ALARM, "A")
        told.append(bool(named) and named[0].name == WORN)
    return told
