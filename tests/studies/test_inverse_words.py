"""Ranks of the study of inverse dynamics: only what seeds tell apart is put in order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.studies.inverse_cases import Held
from hil.studies.inverse_fits import Found, Judged, Seen, Shown, apart
from hil.studies.inverse_methods import ROWS, USUAL_EPOCHS
from hil.studies.inverse_tables import TEXTS, TITLES, summary

NAN = np.full(2, np.nan)


def judged(error: float) -> Judged:
    return Judged(np.full(2, error), NAN, NAN, NAN, NAN, shown=Shown(np.zeros((1, 2))))


def found(**errors: tuple[float, ...]) -> Found:
    seeds = len(next(iter(errors.values())))
    held = {0.001: Held(0.004, np.full(2, 0.1)), 0.02: Held(0.024, np.full(2, 0.9))}
    one = np.zeros(1), np.zeros((1, 2))
    seen = Seen(*one, *one[1:] * 2, np.full(2, 0.5), np.full(2, 0.2), held, 125.0)
    scores = {name.replace("_", "-"): [judged(e) for e in told] for name, told in errors.items()}
    return Found("honest", scores, {}, [seen] * seeds, {})


def told(**errors: tuple[float, ...]) -> str:
    return "\n".join(summary([found(**errors)]))


def test_a_common_spread_does_not_hide_a_steady_difference() -> None:
    assert apart(found(a=(1.0, 2.0, 3.0), b=(1.1, 2.11, 3.1)), "a", "b")


def test_a_difference_within_two_seed_sigma_is_none() -> None:
    assert not apart(found(a=(1.0, 1.3, 1.6), b=(1.2, 1.2, 1.8)), "a", "b")


def test_fewer_than_three_seeds_rank_nothing() -> None:
    assert not apart(found(a=(1.0,), b=(9.0,)), "a", "b")
    assert not apart(found(a=(1.0, 1.1), b=(9.0, 9.1)), "a", "b")


@pytest.mark.thorough
@pytest.mark.parametrize(("seeds", "percent"), [(3, 7.4), (5, 1.1)])
def test_equal_methods_are_ranked_as_rarely_as_documented(seeds: int, percent: float) -> None:
    random = np.random.default_rng(4)
    draws = random.normal(size=(3000, 2, seeds))
    ranked = [apart(found(a=tuple(a), b=tuple(b)), "a", "b") for a, b in draws]
    assert 100 * np.mean(ranked) == pytest.approx(percent, abs=1.2)


@pytest.mark.parametrize(("seeds", "why"), [(1, "one draw ranks nothing"), (2, "2 draws rank")])
def test_too_few_seeds_say_so_wherever_two_rows_are_compared(seeds: int, why: str) -> None:
    text = told(
        wls=(5.0,) * seeds, delan_dissipative=(9.0,) * seeds, delan_coulomb=(1.0,) * seeds,
        proposed=(4.0,) * seeds, rc_motion=(3.0,) * seeds, ours=(0.5,) * seeds,
    )  # fmt: skip
    sentences = [line for line in text.splitlines() if "to repeat" not in line]
    assert len(sentences) == 4
    assert all(why in line for line in sentences)


def test_six_and_proposed_are_not_ranked_when_seeds_disagree() -> None:
    text = told(delan_coulomb=(1.0, 1.3, 1.1), proposed=(1.1, 1.2, 1.0))
    assert "are not told apart: they differ by less than two seed-σ" in text


@pytest.mark.parametrize(
    ("six", "proposed", "ahead"),
    [
        ((1.5, 1.6, 1.7), (1.0, 1.1, 1.2), "Proposed (1.1"),
        ((1.0, 1.1, 1.2), (1.5, 1.6, 1.7), "Method 6 (1.1"),
    ],
)
def test_who_is_ahead_of_six_and_proposed_is_said(
    six: tuple[float, ...], proposed: tuple[float, ...], ahead: str
) -> None:
    assert f"{ahead} N·m) is ahead of" in told(delan_coulomb=six, proposed=proposed)


def test_the_papers_order_is_confirmed_where_it_holds() -> None:
    five = (5.0, 5.1, 5.2)
    text = told(delan=(9.0, 9.1, 9.2), delan_dissipative=five, proposed=(1.0, 1.1, 1.2))
    assert "the paper's order holds" in text


def test_the_papers_order_is_denied_where_it_does_not_hold() -> None:
    five = (5.0, 5.1, 5.2)
    text = told(delan=(4.0, 4.1, 4.2), delan_dissipative=five, proposed=(1.0, 1.1, 1.2))
    assert "order does not hold in Method 4 > Method 5 (dissipative)." in text
    assert "order holds" not in text


def test_the_papers_order_is_not_denied_by_seeds_that_disagree() -> None:
    text = told(delan=(4.0, 6.0, 4.9), delan_dissipative=(5.0, 5.1, 5.2))
    assert "does not hold" not in text
    assert "not told apart from another in Method 4 > Method 5 (dissipative): they" in text


def test_ours_is_set_against_the_best_of_one_to_six_and_the_noise() -> None:
    wls, three = (1.2, 1.2, 1.2), (9.0, 9.0, 9.0)
    text = told(wls=wls, delan=three, ours=(0.3, 0.3, 0.3), proposed=(0.1, 0.1, 0.1))
    assert "75 % less than the best of Methods 1 to 6, Method 1: WLS, 1.2 N·m." in text
    assert "closes 90 % of the gap to the noise, if that is white" in text


def test_without_ours_nobody_of_six_is_said_to_be_the_best() -> None:
    text = told(wls=(1.0, 1.0), irls=(1.1, 1.1))
    assert "the least error of Methods 1 to 6 is 1 N·m (Method 1: WLS)." in text
    assert "best" not in text


def test_ours_is_not_ahead_of_six_when_seeds_disagree() -> None:
    text = told(wls=(1.0, 1.2, 1.4), ours=(0.9, 1.3, 1.0))
    assert "1.2 N·m (not told apart: they differ by less than two seed-σ)." in text
    assert "gap" not in text


def test_a_correction_that_does_harm_is_said_to() -> None:
    text = told(proposed=(1.0, 1.0, 1.0), rc_motion=(1.1, 1.1, 1.1))
    assert "10 % more than Proposed." in text


def test_a_correction_whose_seeds_disagree_is_not_told_apart() -> None:
    text = told(proposed=(1.0, 1.0, 1.0), rc_motion=(0.8, 1.1, 0.9))
    assert "7 % less than Proposed (not told apart: " in text


def test_a_correction_that_was_dropped_everywhere_takes_no_credit() -> None:
    text = told(wls=(1.0, 1.1, 1.2), ours=(0.5, 0.5, 0.6), ours_residual=(0.5, 0.5, 0.6))
    assert "ours: friction with memory leaves" in text
    assert "with a residual network leaves" not in text
    same = told(proposed=(1.0, 1.1, 1.2), rc_motion=(1.0, 1.1, 1.2))
    assert "Proposed with RC, no torque leaves 1.1 N·m, the same as Proposed." in same


def test_a_small_difference_is_not_said_to_be_none() -> None:
    text = told(proposed=(1.0, 1.1, 1.2), rc_motion=(0.999, 1.099, 1.199))
    assert "under half a per cent less than Proposed" in text


def test_two_that_are_ahead_by_little_are_printed_with_more_digits() -> None:
    text = told(delan_coulomb=(2.0241,) * 3, proposed=(2.0182,) * 3)
    assert "Proposed (2.018 N·m) is ahead of Method 6 (2.024 N·m)" in text


def test_what_sees_torque_is_set_against_repeating_it() -> None:
    text = told(proposed=(1.0, 1.0), rc_history=(0.8, 0.8))
    assert "torque history until 24 ms before leaves 0.8 N·m; to repeat the torque of" in text
    assert "to repeat the torque of 24 ms ago leaves 0.9 N·m" in text


@pytest.mark.parametrize(("rate_hz", "ms"), [(1000.0, "20"), (125.0, "24"), (500.0, "20")])
def test_a_history_is_as_old_as_whole_samples_of_the_data_are(rate_hz: float, ms: str) -> None:
    words = ROWS["rc-history"].words_at(rate_hz)
    assert words == f"Proposed with RC, torque history until {ms} ms before"
    assert ROWS["rc-motion"].words_at(rate_hz) == ROWS["rc-motion"].words


def test_what_the_loops_add_is_said_with_its_doubt() -> None:
    text = told(proposed_joint=(1.0, 1.1, 1.2), proposed=(0.8, 1.2, 1.1))
    assert "hybrid instead of joint learning leaves 1.03 N·m, 6 % less than joint" in text
    assert "joint learning (not told apart: they differ by less than two seed-σ)." in text


def test_settings_as_printed_are_set_against_ours() -> None:
    text = told(proposed=(1.0, 1.0, 1.0), proposed_literal=(3.0, 3.0, 3.0))
    assert "with its settings as printed leaves 3 N·m, 200 % more than with ours." in text


def test_only_the_split_is_said_to_be_the_papers() -> None:
    assert TITLES["paper"] == "Samples split as in the paper"
    assert f"at most {USUAL_EPOCHS['lagrangian']} epochs, and the dissipative" in TEXTS["paper"][1]


def under_load(**errors: tuple[float, float]) -> str:
    """The summary of rows with these errors when nobody told of a load, and told of it."""
    bare = found(**dict.fromkeys(errors, (1.0, 1.0)))
    for name, (unaware, aware) in errors.items():
        for score in bare.scores[name.replace("_", "-")]:
            score.unaware[3], score.aware[3] = np.full(2, unaware), np.full(2, aware)
    return "\n".join(summary([replace(bare, loads={3: "5 kg"})]))


def test_a_load_nobody_told_of_is_set_against_one_that_was_told() -> None:
    text = under_load(wls=(9.0, 1.5), ours=(9.5, 0.6))
    assert "with 5 kg: nobody told of it, the least error is 9 N·m (Method 1: WLS); " in text
    assert "; told of it, the least error is 0.6 N·m (ours: friction with memory)." in text


def test_who_is_handed_the_torque_does_not_bear_a_load_nobody_told_of_best() -> None:
    text = under_load(rc_paper=(0.2, 0.1), wls=(9.0, 1.5))
    assert "nobody told of it, the least error is 9 N·m (Method 1: WLS)" in text
    assert "told of it, the least error is 1.5 N·m (Method 1: WLS)" in text
    assert f"0.2 N·m ({ROWS['rc-paper'].words}) is the least of the rows that see" in text
    assert "they were handed the answer" in text


def test_who_says_nothing_under_a_load_is_not_the_best_there() -> None:
    text = under_load(lmi=(np.nan, np.nan), wls=(9.0, 1.5))
    assert "nobody told of it, the least error is 9 N·m (Method 1: WLS)" in text
