"""`hil bench diffnea` compares like with like."""

from __future__ import annotations

from hil.cli.bench import measure


def test_nobody_finds_a_lower_loss_than_the_newton_steps() -> None:
    figures = measure("diffnea", quick=True)["figures"]
    assert figures["newton_excess"] == 0.0
    assert figures["lbfgs_excess"] > 0.0
    assert figures["lbfgs_rows_excess"] > 0.0
