"""Golden vectors, and how closely a program has to agree with them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.export.agreement import (
    DOUBLE,
    SINGLE,
    Golden,
    closeness,
    golden_of,
    largest_difference,
    precision,
    scale_of,
)
from hil.export.program import program_of
from tests.support.export_models import fitted


@pytest.mark.thorough
def test_golden_motions_turn_round_and_rest() -> None:
    golden = golden_of(fitted("rigid-wls"))
    assert np.all(golden.qd.min(axis=0) < 0)
    assert np.all(golden.qd.max(axis=0) > 0)
    assert np.all(np.sum(golden.qd == 0.0, axis=0) >= 30)
    assert np.all(np.abs(golden.loaded - golden.bare).max(axis=0)[:5] > 0.01)


def test_a_joint_that_needs_nothing_does_not_make_rounding_a_fault() -> None:
    zeros, some = np.zeros((3, 1)), np.full((3, 1), 5.0)
    golden = Golden(zeros, zeros, zeros, np.hstack([zeros, some]), np.hstack([zeros, 2 * some]))

    def step(inputs):
        loaded = inputs[3][0, 0] > 0
        return [np.array([[1e-16, 5.0 * (1 + loaded)]])]

    assert largest_difference(step, golden, 0) < 1e-9
    assert scale_of(golden.bare, golden.loaded) == pytest.approx([1e-3, 10.0])


def test_what_is_no_number_is_endlessly_off() -> None:
    zeros = np.zeros((3, 1))
    golden = Golden(zeros, zeros, zeros, zeros + 1.0, zeros + 1.0)
    assert largest_difference(lambda _: [np.full((1, 1), np.nan)], golden, 0) == np.inf


@pytest.mark.thorough
def test_double_precision_is_held_to_more_than_single() -> None:
    assert precision(program_of(fitted("rigid-wls"))) == DOUBLE
    assert precision(program_of(fitted("residual folds"))) == DOUBLE
    program = program_of(fitted("lagrangian: stribeck dahl"))
    for kind, expected in (("double", DOUBLE), ("float", SINGLE)):
        kept = replace(program, lagrangian=replace(program.lagrangian, kind=kind))
        assert precision(kept) == expected


@pytest.mark.thorough
def test_a_residual_is_judged_by_its_own_size() -> None:
    model = fitted("residual folds")
    golden = golden_of(model, 60)
    limits = closeness(program_of(model), golden)
    own = np.abs(golden.residuals).max(axis=(0, 1))
    assert np.any(own > 0)
    assert np.all(limits.residual <= 1.1e-5 * np.maximum(own, 1e-4 * limits.largest))
    inner = golden_of(model.base_, 60)
    assert np.allclose(golden.bare - golden.residuals[0], inner.bare, rtol=0, atol=1e-12)
    assert inner.residuals is None
