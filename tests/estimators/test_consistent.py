"""Least squares over robots that can exist: a known optimum, bounds that hold, clear messages."""

import builtins
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import minimize

from hil.core.errors import FitError, PluginError
from hil.dynamics import RobotModel, base_parameters
from hil.dynamics.inertial import from_pseudo_inertia, pseudo_inertia
from hil.estimators.consistent import ReferenceCoordinates, consistent_least_squares
from hil.estimators.inertial_bounds import InertialBounds, _mass_from_torque
from tests.support.synthetic_motion import fourier, nominal, plant

EYE = np.array([1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 2.0, 0.0, 0.0, 2.0])
"""Parameters whose pseudo-inertia is the unit matrix."""


@pytest.fixture(scope="module")
def base():
    return base_parameters(nominal(), rotor=True)


@pytest.fixture(scope="module")
def bounds():
    return InertialBounds.nominal(nominal())


@pytest.fixture(scope="module")
def noisy(base):
    """Torques of the true arm with so much noise that least squares finds no arm at all."""
    _, q, qd, qdd = fourier(3, samples=150)
    X = base.reduce(nominal().regressor(q, qd, qdd))
    random = np.random.default_rng(1)
    return X, X @ base.combine(plant().parameters()) + 3.0 * random.normal(size=len(X))


def bodies(inertial):
    return inertial[:60].reshape(6, 10)


def test_without_noise_the_true_base_parameters_are_found(base, bounds, noisy) -> None:
    X, _ = noisy
    true = base.combine(plant().parameters())
    found = consistent_least_squares(X, X @ true, base=base, bounds=bounds)
    assert X @ found.base == pytest.approx(X @ true, abs=1e-3)


def test_every_link_can_exist_where_least_squares_cannot(base, bounds, noisy) -> None:
    X, y = noisy
    found = consistent_least_squares(X, y, base=base, bounds=bounds)
    assert np.min(np.linalg.eigvalsh(pseudo_inertia(bodies(found.inertial)))) > 0
    assert found.least_eigenvalue > 0
    for body in bodies(found.inertial):
        inertia = pin.Inertia.FromDynamicParameters(body)
        principal = np.sort(np.linalg.eigvalsh(inertia.inertia))
        assert inertia.mass > 0
        assert principal[0] + principal[1] >= principal[2] > 0
    assert np.all(found.inertial[60:] >= 0)
    assert found.excess > 0


def test_masses_and_centres_of_mass_stay_inside_their_bounds(base, bounds, noisy) -> None:
    X, y = noisy
    found = bodies(consistent_least_squares(X, y, base=base, bounds=bounds).inertial)
    assert np.all(found[:, 0] <= bounds.mass_max * (1 + 1e-6))
    centre = found[:, 1:4] / found[:, :1]
    assert np.all(centre >= bounds.box[:, 0] - 1e-6)
    assert np.all(centre <= bounds.box[:, 1] + 1e-6)


def test_base_parameters_are_those_of_the_full_ones(base, bounds, noisy) -> None:
    X, y = noisy
    found = consistent_least_squares(X, y, base=base, bounds=bounds)
    assert found.base == pytest.approx(base.combine(found.inertial), abs=1e-12)
    assert found.coefficients[: base.rank] == pytest.approx(found.base)


def test_mass_matrices_are_positive_definite_everywhere(base, bounds, noisy) -> None:
    X, y = noisy
    found = consistent_least_squares(X, y, base=base, bounds=bounds)
    q = np.random.default_rng(0).uniform(-3, 3, (50, 6))
    unit = np.eye(6)
    for pose in q:
        rows = np.repeat(pose[None], 6, axis=0)
        still = np.zeros_like(rows)
        W = nominal().regressor(rows, still, unit) - nominal().regressor(rows, still, still)
        M = (W @ found.inertial).reshape(6, 6)
        assert pytest.approx(M.T, abs=1e-9) == M
        assert np.linalg.eigvalsh(M)[0] > 0


def test_friction_that_would_give_energy_is_held_at_zero(base, bounds, noisy) -> None:
    X, y = noisy
    random = np.random.default_rng(4)
    extra = random.normal(size=(len(X), 2))
    y = y + extra @ [-1.0, -2.0]
    found = consistent_least_squares(
        np.hstack([X, extra]), y, base=base, bounds=bounds, nonnegative=[0]
    )
    assert found.extra[0] == pytest.approx(0.0, abs=1e-6)
    assert found.extra[1] == pytest.approx(-2.0, abs=0.5)


def test_the_prior_decides_what_no_torque_shows(base, bounds, noisy) -> None:
    X, y = noisy
    free = consistent_least_squares(X, y, base=base, bounds=bounds)
    held = consistent_least_squares(X / 3, y / 3, base=base, bounds=bounds, prior=1e6)
    assert held.least_eigenvalue > 0.9
    assert bodies(held.inertial)[:, 0] == pytest.approx(bounds.reference[:, 0], rel=0.02)
    assert free.least_eigenvalue < 0.1


def test_a_body_that_cannot_exist_is_drawn_to_the_reference_until_it_can(bounds) -> None:
    space = ReferenceCoordinates(bounds)
    wanted = space.reference.copy()
    wanted[:10] = space.symmetric.T @ np.diag([-0.5, 1.1, 0.9, 1.05]).ravel()
    s = space.drawn_inside(wanted, 1e-3)
    assert space.least_eigenvalue(s) == pytest.approx(1e-3)
    assert s[10:] == pytest.approx(space.reference[10:])


def test_a_body_seen_whole_is_projected_like_scipys_search() -> None:
    target = from_pseudo_inertia(np.diag([-0.5, 1.5, 0.8, 1.1]))
    one_link = type("OneLink", (), {})
    one_link.rank, one_link.independent = 11, np.arange(11)
    one_link.dependent, one_link.combination = np.arange(0), np.zeros((11, 0))
    one_link.combine = lambda full: full
    wide = np.array([[[-9.0] * 3, [9.0] * 3]])
    bounds = InertialBounds(EYE[None], np.array([9.0]), wide)
    y = np.append(target, 0.3)
    found = consistent_least_squares(np.eye(11), y, base=one_link, bounds=bounds)

    def distance(u):
        U = np.zeros((4, 4))
        U[np.triu_indices(4)] = u
        return np.sum((from_pseudo_inertia(U @ U.T) - target) ** 2)

    starts = (np.random.default_rng(k).normal(size=10) for k in range(5))
    best = min((minimize(distance, start, tol=1e-12) for start in starts), key=lambda r: r.fun)
    assert found.excess == pytest.approx(best.fun, rel=1e-2)
    assert found.inertial[10] == pytest.approx(0.3, abs=1e-6)


def test_a_robot_without_masses_gets_wide_bounds_and_a_note(tmp_path) -> None:
    links = "".join(f'<link name="l{k}"/>' for k in range(3))
    joints = "".join(
        f'<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="60" velocity="2"/></joint>'
        for k in range(2)
    )
    path = tmp_path / "bare.urdf"
    path.write_text(f'<robot name="bare">{links}{joints}</robot>', "utf-8")
    bounds = InertialBounds.nominal(RobotModel.from_urdf(path))
    (note,) = bounds.notes
    assert "contains no mass for any link" in note
    assert bounds.mass_max == pytest.approx(2 * 60 / (9.81 * 0.3))
    assert np.min(np.linalg.eigvalsh(pseudo_inertia(bounds.reference))) > 0
    assert np.all(ReferenceCoordinates(bounds).limits @ ReferenceCoordinates(bounds).reference < 1)


def test_nominal_bodies_are_strictly_inside_their_own_bounds(bounds) -> None:
    space = ReferenceCoordinates(bounds)
    assert np.all(space.limits @ space.reference < space.room - 1e-3)
    assert bounds.notes == ()
    assert space.to_parameters[:60, :60] @ space.reference == pytest.approx(
        bounds.reference.ravel()
    )


def test_a_missing_solver_is_named_with_the_extra_that_brings_it(
    base, bounds, noisy, monkeypatch
) -> None:
    real = builtins.__import__

    def without_cvxpy(name, *rest):
        if name == "cvxpy":
            raise ModuleNotFoundError("No module named 'cvxpy'", name="cvxpy")
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without_cvxpy)
    with pytest.raises(PluginError, match="cvxpy") as caught:
        consistent_least_squares(*noisy, base=base, bounds=bounds)
    assert "hil[identify]" in caught.value.hint


@pytest.mark.parametrize(("turns", "most_kg"), [(True, 200.0 / 9.81), (False, 600.0 / 9.81)])
def test_links_without_nominal_masses_are_bounded_by_what_a_joint_holds(turns, most_kg) -> None:
    robot = SimpleNamespace(
        effort_max=np.array([300.0]), joint_geometry=lambda: SimpleNamespace(turns=[turns])
    )
    assert _mass_from_torque(robot, 3.0) == pytest.approx(most_kg)


def test_a_solution_that_the_solver_did_not_finish_is_refused(bounds, monkeypatch) -> None:
    import cvxpy

    monkeypatch.setattr(cvxpy.Problem, "status", property(lambda self: "user_limit"))
    base = base_parameters(nominal(), rotor=True)
    X = np.eye(base.rank)
    with pytest.raises(FitError, match="user_limit"):
        consistent_least_squares(X, np.ones(base.rank), base=base, bounds=bounds)
