"""The long must-show runs of the recorder: `make proof`; `make soak` is the whole day."""

from __future__ import annotations

from typing import Any

import pytest

from hil.cli.bench import measure

pytestmark = pytest.mark.proof


def shown(name: str, **options: Any) -> dict[str, float]:
    """The figures, printed for people: `make proof` runs with -s."""
    figures: dict[str, float] = measure(name, **options)["figures"]
    print(name, figures)  # noqa: T201
    return figures


def test_200_kills_leave_no_unreadable_file_and_lose_a_quarter_second_at_most() -> None:
    figures = shown("crash")
    assert figures["kills"] == 200
    assert figures["unreadable"] == 0
    assert figures["worst_loss_s"] <= 0.25


def test_an_hour_at_500_hz_has_no_gap_without_explanation_and_flat_memory() -> None:
    figures = shown("soak")
    assert figures["simulated_h"] == 1
    assert figures["parts"] > 1
    assert figures["gaps_without_explanation"] == 0
    assert figures["memory_growth_mb"] <= 8
