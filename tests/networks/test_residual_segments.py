"""What a residual network learns from: crops of recordings, slow and fast parts of a residual."""

import numpy as np
import pytest

from hil.core.errors import DataError
from hil.networks.residual_data import Motions, Segments, motion_frequency, slow_and_fast
from tests.support.residual_parts import OFFSETS, ROWS, motions, small
from tests.support.synthetic_motion import moving

T = np.arange(4000) / 1000.0
HEARD = ("motion", "history", "measured")
STEADY = np.array([0, 4000])
ALL = np.ones(4000, dtype=bool)


def swinging(*waves: tuple[float, float]) -> Motions:
    """One joint whose velocity is a sum of sines, each (amplitude, frequency)."""
    qd = sum(a * np.sin(2 * np.pi * f * T) for a, f in waves)[:, None]
    return Motions(qd, qd, qd, qd, None, STEADY, 1000.0)


def test_the_motions_frequency_is_that_of_its_fastest_wave() -> None:
    assert motion_frequency(swinging((1.0, 0.5), (1.0, 3.0)), ALL) == pytest.approx(3.0, abs=0.6)


def test_waves_of_no_consequence_do_not_count_as_motion() -> None:
    assert motion_frequency(swinging((1.0, 3.0), (0.01, 80.0)), ALL) == pytest.approx(3.0, abs=0.6)


def test_a_motion_that_is_none_has_no_frequency() -> None:
    with pytest.raises(DataError, match="no joint moves"):
        motion_frequency(swinging((0.0, 1.0)), ALL)


def test_series_that_teach_nothing_have_no_say_in_the_motions_frequency() -> None:
    slow, fast = swinging((1.0, 0.5)), swinging((1.0, 20.0))
    qd = np.concatenate([slow.qd, fast.qd])
    both = Motions(qd, qd, qd, qd, None, np.array([0, 4000, 8000]), 1000.0)
    found = motion_frequency(both, np.arange(8000) < 4000)
    assert found == pytest.approx(motion_frequency(slow, ALL))


def test_waves_are_parted_where_rows_to_learn_from_are_drawn_one_by_one() -> None:
    slow, fast = np.sin(2 * np.pi * 0.5 * T), 0.2 * np.sin(2 * np.pi * 25 * T)
    learn = np.random.default_rng(0).random(4000) < 0.6
    parts = slow_and_fast((slow + fast)[:, None], swinging((1.0, 0.5)), 5.0, learn)
    inner = learn & (T > 0.5) & (T < 3.5)
    assert parts[0, inner, 0] == pytest.approx(slow[inner], abs=0.02)


def test_slow_and_fast_waves_are_parted() -> None:
    waves = swinging((1.0, 0.5))
    slow, fast = np.sin(2 * np.pi * 0.5 * T), 0.2 * np.sin(2 * np.pi * 60 * T)
    parts = slow_and_fast((slow + fast)[:, None], waves, 6.0, ALL)[:, 500:-500, 0]
    assert parts[0] == pytest.approx(slow[500:-500], abs=5e-3)
    assert parts[1] == pytest.approx(fast[500:-500], abs=5e-3)


def test_what_is_slow_is_slow_where_a_series_begins_and_ends_as_well() -> None:
    slow = np.sin(2 * np.pi * 0.125 * T)[:, None]
    fast = slow_and_fast(slow, swinging((1.0, 0.125)), 0.6, ALL)[1]
    assert np.abs(fast[:500]).max() < 0.02
    assert np.abs(fast[-500:]).max() < 0.02


@pytest.mark.parametrize("f_cut_hz", [0.2, 5.0, 450.0])
def test_slow_and_fast_add_up(f_cut_hz) -> None:
    residual = np.random.default_rng(0).normal(size=(ROWS, 2))
    learn = np.random.default_rng(1).random(ROWS) < 0.6
    parts = slow_and_fast(residual, motions(), f_cut_hz, learn)
    assert parts.sum(axis=0) == pytest.approx(residual, abs=1e-12)


@pytest.mark.parametrize("every", [1, 2, 4])
def test_no_row_is_learned_from_twice_nor_one_that_must_not(every) -> None:
    allowed = np.random.default_rng(0).random(ROWS) < 0.6
    crops = Segments.of(motions(), allowed, small(every=every))
    rows = crops.rows[crops.counted]
    assert len(np.unique(rows)) == len(rows)
    assert np.all(allowed[rows])


def test_with_every_instant_all_rows_are_learned_from() -> None:
    allowed = np.random.default_rng(0).random(ROWS) < 0.6
    crops = Segments.of(motions(), allowed, small(every=1))
    assert np.array_equal(np.sort(crops.rows[crops.counted]), np.flatnonzero(allowed))


def test_instants_far_apart_have_every_phase() -> None:
    crops = Segments.of(motions(), np.ones(ROWS, dtype=bool), small(every=4))
    rows = crops.rows[crops.counted]
    assert set((rows[rows < OFFSETS[1]] % 4).tolist()) == {0, 1, 2, 3}
    assert len(rows) == pytest.approx(ROWS / 4, abs=8)


def test_instants_are_as_far_apart_as_the_sample_rate_allows() -> None:
    assert [small().apart(rate) for rate in (1000.0, 500.0, 125.0)] == [4, 2, 1]


def test_a_history_of_torque_is_as_recorded_and_the_papers_torque_is_filtered() -> None:
    recorded = moving(0)
    data = recorded.with_columns(effort_f=recorded["effort"] + 1.0)
    base = np.zeros_like(data["q"])
    heard = {k: Motions.of(data, base, small(inputs=k)).effort for k in HEARD}
    assert heard["motion"] is None
    assert heard["history"] is data["effort"]
    assert heard["measured"] is data["effort_f"]
