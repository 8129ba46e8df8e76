"""Conformal bands: how wide they are, and how often they hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from hil.core.errors import FitError, SpecError
from hil.core.typing import FloatArray, IntArray
from hil.estimators.conformal import SpeedBands, conformal_quantile, weighted_quantile

# Bands per joint and speed range: quantiles, ranges, what is refused, what a file keeps


def calibration(seed: int = 0, n: int = 2) -> tuple[FloatArray, FloatArray, IntArray]:
    """Ten trajectories whose errors are five times as large at standstill; joint 2's tenfold."""
    random = np.random.default_rng(seed)
    speeds = random.normal(size=(5000, n))
    speeds[random.random(size=speeds.shape) < 0.2] = 0.0
    size = np.where(np.abs(speeds) <= 0.01, 5.0, 1.0) * 10.0 ** np.arange(n)
    return size * random.normal(size=speeds.shape), speeds, np.repeat(np.arange(10), 500)


def test_each_joint_and_range_has_the_width_its_own_errors_need() -> None:
    bands = SpeedBands.calibrate(*calibration(), 0.9)
    quantile = norm.ppf(0.95)
    expected = quantile * np.array([[5.0, 1.0, 1.0, 1.0, 1.0], [50.0, 10.0, 10.0, 10.0, 10.0]])
    np.testing.assert_allclose(bands.half_widths, expected, rtol=0.12)


def test_the_band_at_a_velocity_is_that_of_its_range_in_both_directions() -> None:
    bands = SpeedBands.calibrate(*calibration(), 0.9, ranges=3)
    edges, widths = bands.edges[0], bands.half_widths[0]
    assert edges[0] == 0.01
    for speed, place in ((0.0, 0), (0.01, 0), (0.011, 1), (edges[1] + 1e-9, 2), (99.0, 2)):
        for sign in (-1.0, 1.0):
            qd = np.array([sign * speed, 0.0])
            assert bands.half_width(qd)[0] == widths[place]
            assert bands.half_width(np.vstack([qd, qd]))[1, 0] == widths[place]


def test_where_velocity_is_unknown_so_is_the_band() -> None:
    bands = SpeedBands.calibrate(*calibration(), 0.9)
    width = bands.half_width(np.array([[np.nan, 0.3]]))
    np.testing.assert_array_equal(np.isnan(width), [[True, False]])


def test_the_deviation_is_that_of_a_normal_error_with_such_a_band() -> None:
    for asked in (0.5, 0.9, 0.99):
        bands = SpeedBands.calibrate(*calibration(), asked)
        np.testing.assert_allclose(bands.deviation(np.full((1, 2), 0.5))[0, 0], 1.0, rtol=0.15)


def test_a_row_that_does_not_count_changes_nothing() -> None:
    errors, speeds, blocks = calibration()
    whole = SpeedBands.calibrate(errors, speeds, blocks)
    wild = (np.full((7, 2), np.nan), np.full((7, 2), 3.0), np.zeros(7, dtype=np.int64))
    more = [np.concatenate(pair) for pair in zip((errors, speeds, blocks), wild, strict=True)]
    np.testing.assert_array_equal(SpeedBands.calibrate(*more).half_widths, whole.half_widths)


@pytest.mark.parametrize(
    "few", [slice(None, None, 600), slice(0, 200)], ids=["few samples", "of few trajectories"]
)
def test_a_range_with_too_little_in_it_takes_its_neighbours_along(few: slice) -> None:
    errors, speeds, blocks = calibration()
    speeds[np.abs(speeds) <= 0.01] = 0.5
    speeds[few], errors[few] = 0.0, 1000.0
    bands = SpeedBands.calibrate(errors, speeds, blocks, ranges=4)
    assert np.all(bands.half_widths[:, 0] < 200.0)


def test_a_joint_that_never_moves_has_one_band() -> None:
    errors, speeds, blocks = calibration()
    bands = SpeedBands.calibrate(errors, 0.0 * speeds, blocks)
    assert len(set(bands.half_widths[0])) == 1


def test_the_order_of_rows_does_not_matter() -> None:
    errors, speeds, blocks = calibration()
    order = np.random.default_rng(4).permutation(len(blocks))
    shuffled = SpeedBands.calibrate(errors[order], speeds[order], blocks[order])
    expected = SpeedBands.calibrate(errors, speeds, blocks)
    np.testing.assert_allclose(shuffled.half_widths, expected.half_widths, rtol=1e-12)


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("samples", [1, 50])
def test_one_error_per_trajectory_gives_the_textbook_quantile(samples: int, strict: bool) -> None:
    """Split conformal: the ⌈0.8 · 16⌉ = 13th of 15 errors covers the next with 0.8."""
    sizes = np.random.default_rng(1).permutation(np.arange(1.0, 16.0))
    repeated, blocks = np.repeat(sizes, samples), np.repeat(np.arange(15), samples)
    bound, guaranteed = conformal_quantile(repeated, blocks, 0.8, strict=strict)
    assert bound == 13.0
    assert guaranteed == pytest.approx(0.8, abs=0.01)


def test_a_trajectory_counts_once_however_long_it_is() -> None:
    sizes = np.concatenate([np.full(1000, 9.0), np.arange(1.0, 5.0)])
    weights = np.concatenate([np.full(1000, 0.2 / 1000), np.full(4, 0.2)])
    assert weighted_quantile(sizes, weights, 0.5) == 3.0


def test_more_is_guaranteed_the_more_trajectories_there_are() -> None:
    errors, speeds, blocks = calibration()
    few = blocks < 3
    less = SpeedBands.calibrate(errors[few], speeds[few], blocks[few])
    more = SpeedBands.calibrate(errors, speeds, blocks)
    assert np.all(less.guaranteed < more.guaranteed)
    assert np.all(more.guaranteed >= 0.9 * 10 / 11 - 1e-12)


def test_the_report_counts_what_lies_inside() -> None:
    bands = SpeedBands(0.9, np.array([[0.01]]), np.array([[2.0, 1.0]]), np.array([[0.5, 0.5]]))
    errors = np.array([[1.9], [2.1], [0.9], [-1.1], [0.0], [np.nan]])
    speeds = np.array([[0.0], [0.0], [1.0], [-1.0], [1.0], [1.0]])
    report = bands.coverage(errors, speeds, np.array([0, 0, 0, 0, 1, 1]))
    np.testing.assert_allclose(report.share, [0.75])  # half of the first, all of the second
    np.testing.assert_allclose(report.worst, [0.5])
    np.testing.assert_allclose(report.by_range, [[0.5, 0.75]])
    np.testing.assert_allclose(report.mean_half_width, [7.0 / 5.0])
    assert "75.0 % of the samples of 2 trajectories" in report.line()


def test_bands_survive_a_model_file() -> None:
    bands = SpeedBands.calibrate(*calibration())
    back = SpeedBands.from_arrays(bands.to_arrays())
    qd = np.linspace(-2.0, 2.0, 50)[:, None] * np.ones(2)
    np.testing.assert_array_equal(back.half_width(qd), bands.half_width(qd))
    assert back.asked == bands.asked


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("bands_half_widths", np.full((2, 5), np.nan)),
        ("bands_half_widths", -np.ones((2, 5))),
        ("bands_half_widths", np.ones(5)),
        ("bands_guaranteed", np.ones((2, 4))),
        ("bands_edges", np.ones((2, 3))),
        ("bands_edges", np.tile([4.0, 3.0, 2.0, 1.0], (2, 1))),
        ("bands_coverage", np.array([1.5])),
        ("bands_coverage", np.array([0.9, 0.9])),
    ],
)
def test_damaged_bands_are_refused(name: str, value: FloatArray) -> None:
    arrays = SpeedBands.calibrate(*calibration()).to_arrays() | {name: value}
    with pytest.raises(ValueError):  # noqa: PT011 the words come from numpy for some
        SpeedBands.from_arrays(arrays)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"coverage": 1.0}, "coverage is 1, but must be below 1"),
        ({"coverage": 0.0}, "coverage is 0.0"),
        ({"ranges": 0}, "ranges is 0"),
        ({"standstill": -1.0}, "standstill is -1.0"),
    ],
)
def test_parameters_that_cannot_be_are_refused_by_name(given: dict[str, Any], told: str) -> None:
    with pytest.raises(SpecError, match=told):
        SpeedBands.calibrate(*calibration(), **given)


def test_a_joint_without_any_error_is_named() -> None:
    errors, speeds, blocks = calibration()
    errors[:, 1] = np.nan
    with pytest.raises(FitError, match="joint 2 of 2 has no finite error"):
        SpeedBands.calibrate(errors, speeds, blocks)


def test_arrays_that_do_not_go_together_are_refused() -> None:
    errors, speeds, blocks = calibration()
    with pytest.raises(FitError, match="do not match"):
        SpeedBands.calibrate(errors, speeds, blocks[:-1])


# Bands hold what they are made for of trajectories that can be exchanged for each other


Simulated = tuple[FloatArray, FloatArray, IntArray]
Draw = Callable[[np.random.Generator, int], Simulated]
SAMPLES = 300


def smooth(random: np.random.Generator, trajectories: int, kept: float) -> FloatArray:
    """(trajectories, SAMPLES) unit-variance noise in which each sample resembles the last."""
    noise = random.normal(size=(trajectories, SAMPLES))
    for k in range(1, SAMPLES):
        noise[:, k] = kept * noise[:, k - 1] + np.sqrt(1.0 - kept**2) * noise[:, k]
    return noise


def joined(errors: FloatArray, speeds: FloatArray) -> Simulated:
    blocks = np.repeat(np.arange(len(errors)), SAMPLES)
    return errors.reshape(-1, 1), speeds.reshape(-1, 1), blocks


def alike(random: np.random.Generator, trajectories: int) -> Simulated:
    """Independent samples, whose error grows with speed."""
    speeds = smooth(random, trajectories, 0.9)
    return joined((0.2 + np.abs(speeds)) * random.normal(size=speeds.shape), speeds)


def of_different_sizes(random: np.random.Generator, trajectories: int) -> Simulated:
    """Each trajectory with a scale and an offset of its own, errors that last."""
    scale = np.exp(0.4 * random.normal(size=(trajectories, 1)))
    offset = 0.3 * random.normal(size=(trajectories, 1))
    errors = scale * smooth(random, trajectories, 0.95) + offset
    return joined(errors, smooth(random, trajectories, 0.9))


def constant(random: np.random.Generator, trajectories: int) -> Simulated:
    """One error per trajectory, whatever it does: the worst dependence there is."""
    errors = np.tile(random.standard_t(3, size=(trajectories, 1)), (1, SAMPLES))
    return joined(errors, smooth(random, trajectories, 0.9))


def mean_coverage(draw: Draw, calibrated: int, rounds: int, *, strict: bool) -> tuple[float, float]:
    """Mean share of five new trajectories within the bands, and its standard error."""
    shares = []
    for seed in range(rounds):
        random = np.random.default_rng([seed, calibrated])
        errors, speeds, blocks = draw(random, calibrated + 5)
        known = blocks < calibrated
        bands = SpeedBands.calibrate(
            errors[known], speeds[known], blocks[known], 0.9, ranges=4, strict=strict
        )
        report = bands.coverage(errors[~known], speeds[~known], blocks[~known])
        shares.append(float(report.share[0]))
    return float(np.mean(shares)), float(np.std(shares) / np.sqrt(rounds))


@pytest.mark.thorough
@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("draw", [alike, of_different_sizes, constant])
def test_bands_hold_at_least_the_share_asked_for_on_average(draw: Draw, strict: bool) -> None:
    share, error = mean_coverage(draw, 12, 100, strict=strict)
    assert share >= 0.9 - 3.0 * error - 1e-3


@pytest.mark.parametrize("draw", [alike, of_different_sizes])
def test_bands_hold_little_more_than_the_share_asked_for(draw: Draw) -> None:
    share, _ = mean_coverage(draw, 12, 60, strict=False)
    assert share < 0.94


def test_with_too_few_trajectories_the_lesser_share_that_is_promised_is_kept() -> None:
    errors, speeds, blocks = constant(np.random.default_rng(0), 3)
    bands = SpeedBands.calibrate(errors, speeds, blocks, 0.9, strict=True)
    np.testing.assert_allclose(bands.guaranteed, 0.75)
    share, error = mean_coverage(constant, 3, 200, strict=True)
    assert share >= 0.75 - 3.0 * error
    assert share < 0.9
