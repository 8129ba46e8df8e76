"""Robust weights, and reweighted least squares that ends where statsmodels' does."""

from __future__ import annotations

import numpy as np
import pytest
import statsmodels.api as sm

from hil.estimators.friction_curve import best_exponent, power_of_speed
from hil.estimators.robust import (
    Reweighting,
    RobustRows,
    gram_root,
    influence_slope,
    robust_scale,
    robust_weights,
)

NORMS = {"huber": sm.robust.norms.HuberT(), "tukey": sm.robust.norms.TukeyBiweight()}


@pytest.mark.parametrize("loss", NORMS)
def test_weights_and_slopes_are_those_of_statsmodels(loss) -> None:
    z = np.linspace(-8, 8, 161)
    assert robust_weights(z, loss) == pytest.approx(NORMS[loss].weights(z))
    assert influence_slope(z, loss) == pytest.approx(NORMS[loss].psi_deriv(z).astype(float))


def test_scale_is_the_median_deviation_of_statsmodels() -> None:
    residual = np.random.default_rng(0).standard_t(2, size=(501, 3))
    wanted = [sm.robust.scale.mad(column, center=0) for column in residual.T]
    assert robust_scale(residual) == pytest.approx(wanted, rel=1e-4)


def spoiled(seed=0, N=400):
    random = np.random.default_rng(seed)
    X = np.column_stack([random.normal(size=(N, 2)), np.ones(N)])
    y = X @ [1.0, -2.0, 0.5] + 0.1 * random.normal(size=N)
    y[random.random(N) < 0.1] += 5.0
    return X, y


def rows_of(X, y):
    whole = [(slice(0, len(y)), X, y[:, None])]
    return RobustRows.of(whole, np.ones((1, X.shape[1]), bool))


@pytest.mark.parametrize("loss", NORMS)
def test_coefficients_and_scale_are_those_of_statsmodels(loss) -> None:
    X, y = spoiled()
    fit = Reweighting(rows_of(X, y), loss).run(None)
    wanted = sm.RLM(y, X, M=NORMS[loss]).fit(tol=1e-10, maxiter=500)
    assert fit.solution.coefficients == pytest.approx(wanted.params, abs=2e-4)
    assert fit.scale[0] == pytest.approx(wanted.scale, rel=2e-3)
    assert fit.solution.coefficients == pytest.approx([1.0, -2.0, 0.5], abs=0.06)


def test_joints_have_a_deviation_each() -> None:
    X, quiet = spoiled(1)
    loud = X @ [1.0, -2.0, 0.5] + 3.0 * np.random.default_rng(2).normal(size=len(X))
    both = np.repeat(X, 2, axis=0)
    rows = RobustRows.of(
        [(slice(0, len(X)), both, np.column_stack([quiet, loud]))], np.ones((2, 3), bool)
    )
    fit = Reweighting(rows, "huber").run(None)
    assert fit.scale == pytest.approx([0.1, 3.0], rel=0.35)
    assert fit.solution.coefficients == pytest.approx([1.0, -2.0, 0.5], abs=0.05)


def test_constraints_come_in_and_weights_settle_with_them() -> None:
    X, y = spoiled()

    def held(solution):
        return np.array([1.5, *solution.coefficients[1:]])

    fit = Reweighting(rows_of(X, y), "huber", held).run(None)
    assert fit.solution.coefficients[0] == 1.5
    rest = y - X @ fit.solution.coefficients
    assert fit.scale[0] == pytest.approx(float(robust_scale(rest[:, None])[0]), rel=5e-3)


def test_small_systems_have_the_weighted_gram_matrix() -> None:
    random = np.random.default_rng(0)
    matrix, weight = random.normal(size=(90, 4)) * [1, 1e3, 0, 1e-3], random.random(90)
    root = gram_root(matrix, weight)
    gram, wanted = root.T @ root, matrix.T @ np.diag(weight) @ matrix
    # Entries span fourteen decades: each is compared with the lengths of its columns.
    length = np.sqrt(np.diag(wanted))
    length[2] = 1.0  # a column of zeros
    assert np.all(np.abs(gram - wanted) <= 1e-12 * np.outer(length, length))


def test_power_of_speed_is_the_power_beyond_its_width_and_speed_itself_at_one() -> None:
    qd = np.linspace(-2, 2, 41)
    assert power_of_speed(qd, 1.0, 0.01) == pytest.approx(qd)
    fast = np.abs(qd) > 0.5
    wanted = np.sign(qd) * np.abs(qd) ** 0.4
    assert power_of_speed(qd, 0.4, 0.01)[fast] == pytest.approx(wanted[fast], rel=1e-3)
    assert power_of_speed(np.zeros(1), 0.2, 0.01) == 0.0


def test_the_exponent_of_a_power_law_is_found() -> None:
    qd = np.linspace(-2, 2, 500)
    torque = 3.0 * np.tanh(qd / 0.01) + 2.0 * power_of_speed(qd, 0.6, 0.01) + 0.1
    others = np.column_stack([np.tanh(qd / 0.01), np.ones_like(qd)])
    found = best_exponent(
        torque, others, lambda a: power_of_speed(qd, a, 0.01), np.ones_like(qd), 1.0
    )
    assert found == pytest.approx(0.6, abs=0.01)
