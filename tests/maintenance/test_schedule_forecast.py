"""What a schedule would do: told one by one, or regular probes together, it is the same."""

from __future__ import annotations

from collections import Counter
from datetime import timedelta
from time import process_time
from typing import Any

import pytest

from hil.maintenance.dry_run import Expected, Motions, forecast
from hil.maintenance.ledger import Ledger
from tests.support.schedule_parts import at, schedule

NOW = at("23 03:00") + timedelta(seconds=20)
MOTIONS = Motions(probe=timedelta(seconds=50), campaign=timedelta(seconds=200))


def dense(every: str = "1min", **keys: Any) -> Any:
    return schedule(probe={"spec": "probe.yaml", "every": every}, **keys)


def expected(spec: Any, hours: float, alike: int | None) -> list[Expected]:
    end = NOW + timedelta(hours=hours)
    return forecast(spec, Ledger(None), MOTIONS, NOW, end, alike=alike)


def counted(found: list[Expected]) -> Counter[tuple[str, str]]:
    counts: Counter[tuple[str, str]] = Counter()
    for one in found:
        counts[one.job, one.what] += one.count
    return counts


@pytest.mark.thorough
@pytest.mark.parametrize(
    "keys",
    [
        {},
        {"every": "7min"},
        {"campaign": {"spec": "campaign.yaml", "cron": "0 */5 * * *"}},
        {"campaign": {"spec": "campaign.yaml", "every": "4h30min"}},
        {"blackout": [{"begin": "07:00", "end": "08:00"}]},
        {"missed": "skip", "start": "2026-11-23T03:05:30"},
    ],
    ids=lambda keys: " ".join(keys) or "plain",
)
@pytest.mark.parametrize("hours", [0.3, 9.99, 26])
def test_regular_probes_are_counted_and_not_lost(keys: dict[str, Any], hours: float) -> None:
    spec = dense(**keys)
    all_of_them, together = (expected(spec, hours, alike) for alike in (None, 10))
    assert counted(together) == counted(all_of_them)
    assert together[-1].due == all_of_them[-1].due
    assert [one for one in together if one.job == "campaign"] == [
        one for one in all_of_them if one.job == "campaign"
    ]


def test_a_year_of_minutes_costs_as_much_as_an_hour() -> None:
    began = process_time()
    (*_, last) = found = expected(dense(), 365 * 24, 40)
    assert process_time() - began < 2
    assert sum(one.count for one in found) == 365 * 24 * 60 + 1
    assert len(found) < 100
    assert last.due == NOW + timedelta(days=365) - timedelta(seconds=20)
