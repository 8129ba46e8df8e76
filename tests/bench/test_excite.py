"""`hil bench excite`: what is printed is right, and in the proof the figures that are asked for."""

from __future__ import annotations

import pytest

from hil.cli.bench import measure


@pytest.mark.thorough
def test_the_quick_run_tells_of_everybody_from_the_same_starts(
    capsys: pytest.CaptureFixture[str],
) -> None:
    told = measure("excite", quick=True, seeds=[3])
    lines = capsys.readouterr().err.splitlines()
    drawn = {line.split()[0]: line.split()[3] for line in lines}
    assert drawn["ours"] == drawn["slsqp_differences"] == drawn["slsqp_our_gradient"]
    assert told["figures"]["ours_largest_excess"] == 0
    assert told["figures"]["ours_median_condition"] < 20


@pytest.mark.proof
@pytest.mark.timeout(3600)
def test_ten_random_starts_end_well_conditioned_sooner_than_those_of_the_peers() -> None:
    document = measure("excite")
    figures, ratios = document["figures"], document["ratios"]
    assert {"condition_vs_slsqp_differences", "cpu_vs_slsqp_differences"} <= ratios.keys()
    assert min(ratios.values()) > 1, ratios
    assert figures["ours_median_condition"] <= 11.8
    assert figures["ours_worst_condition"] <= 12.8
    assert figures["ours_worst_cpu_s"] <= 5.0
    assert figures["ours_largest_excess"] == 0
    assert figures["with_collisions_largest_excess"] == 0
    assert figures["with_collisions_worst_condition"] < 20
