"""Bands hold what they are made for of trajectories that can be exchanged for each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hil.core.typing import FloatArray, IntArray
from hil.estimators.conformal import SpeedBands

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
