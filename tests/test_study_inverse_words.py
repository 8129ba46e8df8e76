"""Ranks of the study of inverse dynamics: only what seeds tell apart is put in order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.study.inverse_found import Found, Seen
from hil.study.inverse_noise import Held
from hil.study.inverse_score import Judged, Shown
from hil.study.inverse_words import apart, summary

NAN = np.full(2, np.nan)


def judged(error: float) -> Judged:
    return Judged(np.full(2, error), NAN, NAN, NAN, NAN, shown=Shown(np.zeros((1, 2))))


def found(**errors: tuple[float, ...]) -> Found:
    seeds = len(next(iter(errors.values())))
    held = {0.001: Held(0.004, np.full(2, 0.1)), 0.02: Held(0.024, np.full(2, 0.9))}
    one = np.zeros(1), np.zeros((1, 2))
    seen = Seen(*one, *one[1:] * 2, np.full(2, 0.5), np.full(2, 0.2), held)
    scores = {name.replace("_", "-"): [judged(e) for e in told] for name, told in errors.items()}
    return Found("honest", scores, {}, [seen] * seeds, {})


def told(**errors: tuple[float, ...]) -> str:
    return "\n".join(summary([found(**errors)]))


def test_a_common_spread_does_not_hide_a_steady_difference() -> None:
    assert apart(found(a=(1.0, 2.0, 3.0), b=(1.1, 2.11, 3.1)), "a", "b")


def test_a_difference_within_two_seed_sigma_is_none() -> None:
    assert not apart(found(a=(1.0, 1.3, 1.6), b=(1.2, 1.2, 1.8)), "a", "b")


def test_one_seed_ranks_nothing() -> None:
    assert not apart(found(a=(1.0,), b=(9.0,)), "a", "b")


def test_one_seed_says_that_it_is_one() -> None:
    assert "one seed cannot tell" in told(delan_coulomb=(1.0,), proposed=(9.0,))


def test_six_and_proposed_are_not_ranked_when_seeds_disagree() -> None:
    assert "are not ranked" in told(delan_coulomb=(1.0, 1.3), proposed=(1.1, 1.2))


@pytest.mark.parametrize(
    ("six", "proposed", "ahead"),
    [((1.5, 1.6), (1.0, 1.1), "Proposed (1.05"), ((1.0, 1.1), (1.5, 1.6), "Method 6 (1.05")],
)
def test_who_is_ahead_of_six_and_proposed_is_said(
    six: tuple[float, ...], proposed: tuple[float, ...], ahead: str
) -> None:
    assert f"{ahead} N·m) is ahead of" in told(delan_coulomb=six, proposed=proposed)


def test_the_papers_order_is_confirmed_where_it_holds() -> None:
    text = told(delan=(9.0, 9.1), delan_dissipative=(5.0, 5.1), proposed=(1.0, 1.1))
    assert "the paper's order holds" in text


def test_the_papers_order_is_denied_where_it_does_not_hold() -> None:
    text = told(delan=(4.0, 4.1), delan_dissipative=(5.0, 5.1), proposed=(1.0, 1.1))
    assert "order does not hold in Method 4 > Method 5 (dissipative)." in text
    assert "order holds" not in text


def test_ours_is_set_against_the_best_of_one_to_six_and_the_noise() -> None:
    text = told(wls=(1.2, 1.2), delan=(9.0, 9.0), ours=(0.3, 0.3), proposed=(0.1, 0.1))
    assert "75 % less than the best of Methods 1 to 6 (Method 1: WLS, 1.2 N·m)" in text
    assert "closes 90 % of the gap to the noise" in text


def test_a_correction_that_does_harm_is_said_to() -> None:
    assert "10 % more than Proposed" in told(proposed=(1.0, 1.0), rc_motion=(1.1, 1.1))


def test_what_sees_torque_is_set_against_repeating_it() -> None:
    text = told(proposed=(1.0, 1.0), rc_history=(0.8, 0.8))
    assert "to repeat the torque of 24 ms ago leaves 0.9 N·m" in text


def test_what_the_loops_add_is_said_with_its_doubt() -> None:
    text = told(proposed_joint=(1.0, 1.1), proposed=(0.8, 1.2))
    assert (
        "hybrid instead of joint learning leaves 1 N·m, 5 % less, by less than two seed-σ." in text
    )


def test_a_load_nobody_told_of_is_set_against_one_that_was_told() -> None:
    bare = found(wls=(1.0, 1.0), ours=(0.3, 0.3))
    for key, unaware, aware in (("wls", 9.0, 1.5), ("ours", 9.5, 0.6)):
        for score in bare.scores[key]:
            score.unaware[3], score.aware[3] = np.full(2, unaware), np.full(2, aware)
    text = "\n".join(summary([replace(bare, loads={3: "5 kg"})]))
    assert "with 5 kg that nobody told of, the least error is 9 N·m (Method 1: WLS)" in text
    assert "told of it, 0.6 N·m (ours: friction with memory)." in text
