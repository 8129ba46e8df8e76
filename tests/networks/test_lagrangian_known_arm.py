"""A network that is a known arm: a point mass on a pan and a tilt joint, against Pinocchio.

M = diag(m l² cos²q₂, m l²) and V = m g l sin q₂ need |cos q₂| and sin q₂, which four ReLU units on
[cos q, sin q] give exactly; weights are set by hand.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.lagrangian import LagrangianNetwork  # noqa: E402
from hil.networks.lagrangian_settings import NetworkSettings  # noqa: E402

MASS, LENGTH, G = 2.3, 0.7, 9.81


@pytest.fixture(scope="module")
def pan_tilt():
    model = pin.Model()
    pan = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "pan")
    down = pin.SE3(pin.utils.rpyToMatrix(-np.pi / 2, 0.0, 0.0), np.zeros(3))
    tilt = model.addJoint(pan, pin.JointModelRZ(), down, "tilt")
    point = pin.Inertia(MASS, np.array([LENGTH, 0.0, 0.0]), np.zeros((3, 3)))
    model.appendBodyToJoint(tilt, point, pin.SE3.Identity())
    model.gravity.linear = np.array([0.0, 0.0, -G])
    return model


def by_hand(gravity):
    """The network; the tilt joint turns about −y, so that q₂ > 0 lifts the mass or lowers it."""
    settings = NetworkSettings(
        hidden=(4,), activation="relu", diagonal="relu", gravity=gravity, epsilon=0.0
    )
    net = LagrangianNetwork(2, settings).double()
    root, weight = np.sqrt(MASS) * LENGTH, MASS * G * LENGTH
    heads = {"potential": [[0, 0, -weight, weight]], "head": [[0] * 4, [-weight, weight, 0, 0]]}
    first = np.array([[0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1], [0, 0, 0, -1]])
    last = [[root, root, 0, 0], [0] * 4, [0] * 4, *heads[gravity]]
    state = {
        "trunk.layers.0.weight": first,
        "trunk.layers.0.bias": np.zeros(4),
        "trunk.last.weight": np.array(last),
        "trunk.last.bias": np.array([0.0, root] + [0.0] * (len(last) - 2)),
    }
    net.load_state_dict({key: torch.as_tensor(value) for key, value in state.items()})
    return net


@pytest.fixture(scope="module")
def rows():
    random = np.random.default_rng(1)
    return [random.uniform(-size, size, (50, 2)) for size in (np.pi, 3.0, 8.0)]


def torques(function, rows):
    return np.array([function(*row) for row in zip(*rows, strict=True)])


@pytest.mark.parametrize("gravity", ["potential", "head"])
def test_torque_equals_pinocchios(pan_tilt, rows, gravity) -> None:
    data = pan_tilt.createData()
    expected = torques(lambda *row: pin.rnea(pan_tilt, data, *row), rows)
    found = by_hand(gravity)(*map(torch.as_tensor, rows)).detach().numpy()
    assert found == pytest.approx(expected, abs=1e-11)


def test_mass_matrix_equals_pinocchios(pan_tilt, rows) -> None:
    data = pan_tilt.createData()
    expected = np.array([pin.crba(pan_tilt, data, q) for q in rows[0]])
    found = by_hand("potential").mass(torch.as_tensor(rows[0])).detach().numpy()
    assert found == pytest.approx(expected, abs=1e-12)


def test_coriolis_torque_equals_pinocchios(pan_tilt, rows) -> None:
    data = pan_tilt.createData()
    q, qd, _ = rows
    expected = np.array(
        [
            pin.computeCoriolisMatrix(pan_tilt, data, *row) @ row[1]
            for row in zip(q, qd, strict=True)
        ]
    )
    found = by_hand("potential").parts(*map(torch.as_tensor, rows)).coriolis.detach().numpy()
    assert found == pytest.approx(expected, abs=1e-11)


def test_gravity_torque_equals_pinocchios(pan_tilt, rows) -> None:
    data = pan_tilt.createData()
    expected = np.array([pin.computeGeneralizedGravity(pan_tilt, data, q) for q in rows[0]])
    found = by_hand("potential").parts(*map(torch.as_tensor, rows)).gravity.detach().numpy()
    assert found == pytest.approx(expected, abs=1e-11)
