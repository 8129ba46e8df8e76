"""Pseudo-inertias and their log-Cholesky coordinates, against point masses and differences."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from hil.core.errors import FitError
from hil.core.typing import FloatArray
from hil.dynamics.inertial import (
    body_parameters,
    coordinate_jacobian,
    divergence,
    from_coordinates,
    from_pseudo_inertia,
    is_consistent,
    least_eigenvalue,
    nearest_consistent,
    pseudo_inertia,
    to_coordinates,
    transfer_matrix,
)

ARROWHEAD = body_parameters(1.0, (0.0, 0.0, 0.0), np.diag([0.1, 0.1, 0.5]))
"""Positive moments that no mass density has: 0.1 + 0.1 < 0.5."""


def bodies(count: int, seed: int = 0) -> FloatArray:
    """(count, 10) parameters of clouds of point masses: they certainly can exist."""
    random = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        mass, place = random.uniform(0.1, 2.0, 8), random.normal(0.0, 0.3, (8, 3))
        total = [body_parameters(m, p, np.zeros((3, 3))) for m, p in zip(mass, place, strict=True)]
        found.append(np.sum(total, axis=0))
    return np.array(found)


def test_pseudo_inertia_is_the_second_moment_of_the_mass_density() -> None:
    random = np.random.default_rng(3)
    mass, place = random.uniform(0.1, 2.0, 6), random.normal(size=(6, 3))
    parts = [body_parameters(m, p, np.zeros((3, 3))) for m, p in zip(mass, place, strict=True)]
    phi = np.sum(parts, axis=0)
    points = np.column_stack([place, np.ones(6)])
    np.testing.assert_allclose(pseudo_inertia(phi), points.T @ (mass[:, None] * points), atol=1e-12)


def test_pseudo_inertia_is_the_one_of_pinocchio() -> None:
    phi = bodies(1)[0]
    theirs = pin.PseudoInertia.FromDynamicParameters(phi).toMatrix()
    np.testing.assert_allclose(pseudo_inertia(phi), theirs, atol=1e-12)


def test_coordinates_are_those_of_pinocchio() -> None:
    theta = np.random.default_rng(1).normal(0.0, 0.5, 10)
    theirs = pin.LogCholeskyParameters(theta)
    np.testing.assert_allclose(from_coordinates(theta), theirs.toDynamicParameters(), atol=1e-12)


def test_parameters_come_back_from_their_pseudo_inertia() -> None:
    phi = bodies(5)
    np.testing.assert_allclose(from_pseudo_inertia(pseudo_inertia(phi)), phi, atol=1e-13)


def test_parameters_come_back_from_their_coordinates() -> None:
    phi = bodies(20)
    np.testing.assert_allclose(from_coordinates(to_coordinates(phi)), phi, rtol=1e-9, atol=1e-12)


def test_any_coordinates_are_a_body_that_can_exist() -> None:
    theta = np.random.default_rng(2).normal(0.0, 1.5, (500, 10))
    assert np.all(is_consistent(from_coordinates(theta)))


def test_coordinates_hold_the_mass_and_its_centre() -> None:
    theta = to_coordinates(body_parameters(3.0, (0.1, -0.2, 0.3), 0.02 * np.eye(3)))
    assert np.exp(2 * theta[0]) == pytest.approx(3.0)
    np.testing.assert_allclose(theta[7:], [0.1, -0.2, 0.3])


def test_jacobian_is_what_central_differences_give() -> None:
    theta, step = np.random.default_rng(4).normal(0.0, 0.7, (6, 10)), 1e-6
    ahead = [from_coordinates(theta + step * unit) for unit in np.eye(10)]
    behind = [from_coordinates(theta - step * unit) for unit in np.eye(10)]
    numeric = np.moveaxis((np.array(ahead) - np.array(behind)) / (2 * step), 0, -1)
    np.testing.assert_allclose(coordinate_jacobian(theta), numeric, rtol=1e-7, atol=1e-8)


def test_moments_that_break_the_triangle_inequality_are_refused() -> None:
    assert not is_consistent(ARROWHEAD)
    with pytest.raises(FitError, match="not physically consistent"):
        to_coordinates(ARROWHEAD)


def test_nearest_body_can_exist_and_keeps_what_could() -> None:
    phi = np.array([bodies(1)[0], ARROWHEAD, np.zeros(10)])
    mended = nearest_consistent(phi, 1e-4)
    assert np.all(is_consistent(mended))
    np.testing.assert_array_equal(mended[0], phi[0])


def test_nearest_body_is_nearer_than_any_other_tried() -> None:
    random, share = np.random.default_rng(5), 1e-4
    target = pseudo_inertia(ARROWHEAD)
    best = np.linalg.norm(pseudo_inertia(nearest_consistent(ARROWHEAD, share)) - target)
    root = random.normal(0.0, 0.2, (300, 4, 4))
    others = nearest_consistent(ARROWHEAD, share) + from_pseudo_inertia(
        root @ root.transpose(0, 2, 1)
    )
    assert np.all(np.linalg.norm(pseudo_inertia(others) - target, axis=(1, 2)) > best)


def test_least_eigenvalue_is_zero_for_a_point_mass() -> None:
    point = body_parameters(2.0, (0.1, 0.2, 0.3), np.zeros((3, 3)))
    assert least_eigenvalue(point) == pytest.approx(0.0, abs=1e-12)


def test_divergence_is_zero_for_the_prior_alone() -> None:
    phi = bodies(2)
    assert divergence(phi[0], phi[0]) == pytest.approx(0.0, abs=1e-9)
    assert divergence(phi[0], phi[1]) > 0.01


def test_divergence_does_not_depend_on_the_frame() -> None:
    phi, prior = bodies(2, seed=7)
    pose = pin.XYZQUATToSE3([0.3, -0.1, 0.2, 0.5, 0.5, -0.5, 0.5]).homogeneous
    X = transfer_matrix(pose)
    assert divergence(X @ phi, X @ prior) == pytest.approx(divergence(phi, prior), rel=1e-6)


def test_divergence_is_infinite_for_what_cannot_exist() -> None:
    assert divergence(ARROWHEAD, bodies(1)[0]) == np.inf
