"""The benchmarks of the recorder in small: what they promise about kills and long runs holds."""

from __future__ import annotations

import pytest

from hil.cli.bench import measure
from hil.core.errors import PluginError


@pytest.mark.wire
def test_kills_leave_readable_files_and_lose_a_quarter_second_at_most() -> None:
    figures = measure("crash", quick=True, kills=8)["figures"]
    assert figures["kills"] == 8
    assert figures["files"] >= 8
    assert figures["unreadable"] == 0
    assert figures["unrecovered_runs"] == 0
    assert figures["worst_loss_s"] <= 0.25
    assert figures["plain_writer_worst_loss_s"] > 0.25


@pytest.mark.wire
def test_a_short_soak_reads_back_all_it_has_recorded() -> None:
    figures = measure("soak", hours=0.02)["figures"]
    assert figures["rows"] == 36_000
    assert figures["gaps_without_explanation"] == 0


def test_an_option_that_a_benchmark_does_not_have_is_refused() -> None:
    with pytest.raises(PluginError, match="mcap has no option kills") as caught:
        measure("mcap", kills=3)
    assert "its options are quick" in caught.value.hint
