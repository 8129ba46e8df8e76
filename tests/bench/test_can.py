"""`hil bench can` gives the figures that it names; the proof `bench-can` bounds them."""

from __future__ import annotations

import pytest

from hil.cli.bench import measure

pytestmark = [pytest.mark.wire, pytest.mark.proof]

EACH = (
    "cycle_p50_us",
    "cycle_p99_us",
    "jitter_p50_us",
    "jitter_p99_us",
    "jitter_p999_us",
    "overrun_percent",
    "cpu_us",
)


def test_bench_can_gives_all_figures_of_all_ways_on_one_bus() -> None:
    pytest.importorskip("canopen")
    told = measure("can", seconds=0.1, rounds=1, rates_hz=(1000,))
    for path in (
        "ours",
        "canopen",
        "canopen_documented",
        "ours_ordinary",
        "canopen_documented_ordinary",
        "both_ours",
        "both_canopen",
        "both_ours_ordinary",
        "both_canopen_ordinary",
        "both_canopen_ordinary_virtual",
    ):
        here = {name: told["figures"][f"{path}_1000hz_{name}"] for name in EACH}
        assert here["cpu_us"] > 0
        assert 0 < here["cycle_p50_us"] <= here["cycle_p99_us"]
        assert 0 <= here["overrun_percent"] <= 100
        assert here["cpu_us"] <= told["figures"][f"{path}_1000hz_both_cpu_us"]
    for path in ("ours", "both_ours", "both_canopen", "both_canopen_ordinary"):
        assert told["figures"][f"{path}_1000hz_drives_cpu_us"] > 0
    assert set(told["ratios"]) == {
        "cpu_master_only_vs_tuned_1000hz",
        "cpu_master_only_vs_documented_1000hz",
        "cpu_both_ends_1000hz",
        "cpu_both_ends_ordinary_1000hz",
        "cpu_both_ends_ordinary_virtual_1000hz",
    }
