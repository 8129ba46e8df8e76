"""Five hundred probes of robots that have not changed: how many are called changed?

Ten mock robots, each identified once by the shipped program and probed by the shipped probe, in
rooms from 14 to 30 °C; every run begins cold and warms up, by which friction falls as much as by
the wear that is looked for. Every probe counts, the first ones under a champion too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hil.core.parallel import processes
from hil.models.drift import FALSE_ALARM, causes, chart_of
from hil.models.drift_features import Features
from tests.proofs.null_probes import FIRST_SEED, probes

ROBOTS, PROBES, WORN = 10, 50, 3
NAME = "shoulder_lift_joint friction"

pytestmark = [pytest.mark.proof, pytest.mark.timeout(10800)]


def called_changed(found: list[Features], sigma: list[float], rate: float) -> list[bool]:
    """Of each probe, as `hil drift` says it when it comes."""
    quiet: list[Features] = []
    told = []
    for probe in found:
        chart = chart_of([*quiet, probe], np.array(sigma), rate)
        told.append(bool(chart.alarm.any()))
        quiet = quiet if told[-1] else [*quiet, probe]
    return told


def named_first(found: list[Features], sigma: list[float], worn: Features) -> str:
    """The cause named first when a worn robot's probe follows those of before; empty if none."""
    chart = chart_of([*found, worn], np.array(sigma))
    named = causes(worn, chart, FALSE_ALARM, "A")
    return named[0].name if named else ""


def test_unchanged_robots_are_called_changed_as_rarely_as_stated(tmp_path: Path) -> None:
    seeds = range(FIRST_SEED, FIRST_SEED + ROBOTS)
    with processes(2) as pool:
        waiting = [pool.submit(probes, seed, PROBES, WORN, tmp_path) for seed in seeds]
        taken = [one.result() for one in waiting]
    alarms = [sum(called_changed(found[:PROBES], sigma, FALSE_ALARM)) for found, sigma in taken]
    total = ROBOTS * PROBES
    print(f"{sum(alarms)} of {total} probes alarm, at most {FALSE_ALARM:.0%} stated: {alarms}")  # noqa: T201
    # Every chart has its share as if it stood alone: the rate is a bound, and alarms are fewer.
    assert sum(alarms) <= FALSE_ALARM * total + 3 * np.sqrt(FALSE_ALARM * total)
    # Charts that never call anything would pass the line above.
    named = [
        named_first(found[:PROBES], sigma, worn)
        for found, sigma in taken
        for worn in found[PROBES:]
    ]
    right = named.count(NAME)
    print(f"{right} of {len(named)} probes with 5 % more friction on J2 are named so")  # noqa: T201
    assert right >= 0.95 * len(named)
