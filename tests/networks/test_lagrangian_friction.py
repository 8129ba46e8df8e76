"""Friction networks: Coulomb–viscous and Stribeck with intrinsic parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.networks.lagrangian_settings import FRICTIONS, FrictionSettings

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.lagrangian_friction import friction_network  # noqa: E402

SCALE = np.array([22.0, 4.0, 0.5])
SPEEDS = np.array([-1.5, -0.2, -0.03, -1e-3, 1e-3, 0.07, 0.6, 2.0])[:, None] * np.ones(3)


def tensors(*arrays: np.ndarray) -> list[Any]:
    return [torch.as_tensor(array, dtype=torch.float64) for array in arrays]


def shaken(network: Any, size: float = 1.0, seed: int = 0) -> Any:
    """The network in double precision, its parameters moved about."""
    random = torch.Generator().manual_seed(seed)
    network = network.double()
    with torch.no_grad():
        for parameter in network.parameters():
            shift = torch.randn(parameter.shape, generator=random, dtype=torch.float64)
            parameter.add_(size * shift)
    return network


def motion(count: int = 500, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    speeds = random.normal(size=(count, 3)) * 10.0 ** random.uniform(-4, 0.5, size=(count, 3))
    return random.uniform(-3.0, 3.0, size=(count, 3)), speeds


def descend(network: Any, loss: Callable[[], Any], rate: float, steps: int) -> None:
    """Steps of a falling rate against the sign of the gradient: what Adam does at first.

    torch's own optimisers take two seconds to import.
    """
    for step in range(steps):
        network.zero_grad()
        loss().backward()
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.sub_(rate * (1.0 - step / steps) * torch.sign(parameter.grad))


def torque_of(network: Any, qd: np.ndarray, direction: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        torque = network(*tensors(np.zeros_like(qd), qd, direction))
    return np.asarray(torque)


def test_stribeck_friction_is_equation_18_with_its_own_parameters() -> None:
    network = shaken(friction_network("stribeck", 3, SCALE), 0.5)
    values = network.intrinsic()
    share = np.exp(-((np.abs(SPEEDS) / values["v_s"]) ** values["delta_s"]))
    size = (
        share * values["f_s"]
        + (1 - share) * values["f_c"]
        + np.abs(SPEEDS) ** values["alpha"] * values["f_v"]
    )
    direction = np.tanh(SPEEDS / 0.01)
    expected = direction * size + values["offset"]
    np.testing.assert_allclose(torque_of(network, SPEEDS, direction), expected, rtol=1e-9)


def test_coulomb_viscous_friction_is_equation_3() -> None:
    network = shaken(friction_network("coulomb", 3, SCALE), 0.5)
    values = network.intrinsic()
    direction = np.tanh(SPEEDS / 0.01)
    expected = values["f_c"] * direction + values["f_v"] * SPEEDS + values["offset"]
    np.testing.assert_allclose(torque_of(network, SPEEDS, direction), expected, rtol=1e-9)


def test_the_literal_form_takes_the_hard_sign_whatever_direction_it_is_handed() -> None:
    settings = FrictionSettings.literal()
    for kind in ("stribeck", "coulomb"):
        network = friction_network(kind, 3, SCALE, settings).double()
        smooth = torque_of(network, SPEEDS, np.tanh(SPEEDS / 0.5))
        np.testing.assert_array_equal(smooth, torque_of(network, SPEEDS, np.sign(SPEEDS)))


def test_the_stribeck_speed_that_is_told_is_the_one_that_is_used() -> None:
    network = friction_network("stribeck", 3, SCALE, FrictionSettings.literal()).double()
    with torch.no_grad():
        network.f_s.theta.fill_(0.5)
        network.v_s.theta.copy_(torch.tensor([-0.2, 0.2, 0.0]))
    values, speeds = network.intrinsic(), SPEEDS[SPEEDS[:, 0] > 0]
    share = np.exp(-((speeds / values["v_s"]) ** values["delta_s"]))
    size = share * values["f_s"] + (1 - share) * values["f_c"]
    expected = size + speeds ** values["alpha"] * values["f_v"]
    np.testing.assert_allclose(network.curve(speeds), expected, rtol=1e-9)


def test_the_literal_form_starts_at_the_same_newton_metres_for_every_joint() -> None:
    values = friction_network("stribeck", 3, SCALE, FrictionSettings.literal()).intrinsic()
    np.testing.assert_allclose(values["f_c"], 0.1, rtol=1e-6)
    assert "offset" not in values


def test_scaled_friction_starts_at_a_share_of_each_joints_torque() -> None:
    values = friction_network("stribeck", 3, SCALE).intrinsic()
    for name in ("f_s", "f_c", "f_v"):
        np.testing.assert_allclose(values[name], 0.3 * SCALE, rtol=1e-5)


@pytest.mark.parametrize("kind", ["coulomb", "stribeck"])
def test_friction_never_drives_the_arm_without_its_offset(kind: str) -> None:
    _, qd = motion()
    for seed in range(5):
        network = shaken(friction_network(kind, 3, SCALE), 3.0, seed)
        torque = torque_of(network, qd, np.tanh(qd / 0.01)) - network.intrinsic()["offset"]
        assert np.all(torque * qd >= 0.0)


def test_free_parameters_of_the_paper_can_drive_the_arm() -> None:
    _, qd = motion()
    network = shaken(friction_network("stribeck", 3, SCALE, FrictionSettings.literal()), 3.0)
    assert np.any(torque_of(network, qd, np.sign(qd)) * qd < 0.0)


def test_bounds_hold_however_hard_training_pulls_at_them() -> None:
    network = friction_network("stribeck", 3, SCALE)
    qd = torch.as_tensor(SPEEDS, dtype=torch.float32)
    forbidden = -50.0 * torch.sign(qd) / qd.abs().sqrt()  # It drives the arm, and falls with speed.

    def loss() -> Any:
        return (network(torch.zeros_like(qd), qd, torch.sign(qd)) - forbidden).square().mean()

    descend(network, loss, 1.0, 100)
    values = network.intrinsic()
    settings = FrictionSettings()
    for name in ("f_s", "f_c", "f_v"):
        assert np.all(values[name] >= 0.0)
    for name, (low, high) in {
        "v_s": settings.speed_bounds,
        "delta_s": settings.shape_bounds,
        "alpha": settings.exponent_bounds,
    }.items():
        assert np.all((values[name] >= low * (1 - 1e-5)) & (values[name] <= high * (1 + 1e-5)))


@pytest.mark.parametrize("literal", [False, True])
@pytest.mark.parametrize("kind", FRICTIONS[1:])
def test_gradients_are_finite_at_rest_and_far_off(kind: str, literal: bool) -> None:
    settings = FrictionSettings.literal() if literal else FrictionSettings()
    for size in (0.0, 30.0):
        network = shaken(friction_network(kind, 3, SCALE, settings), size).float()
        qd = torch.tensor([[0.0, 0.0, 0.0], [1e-30, -1e-7, 0.0], [20.0, -20.0, 3.0]])
        qd.requires_grad_()
        network(torch.zeros_like(qd), qd, torch.tanh(qd / 0.01)).square().sum().backward()
        for parameter in (qd, *network.parameters()):
            assert torch.isfinite(parameter.grad).all()


def test_training_finds_the_friction_curve_it_is_shown() -> None:
    qd = np.linspace(-1.5, 1.5, 601)[:, None] * np.ones(3)
    truth = np.sign(qd) * SCALE * (0.5 + 0.2 * np.exp(-np.abs(qd / 0.1)) + 0.3 * np.abs(qd) ** 0.7)
    network = friction_network("stribeck", 3, SCALE)
    speeds, target, scale = (torch.as_tensor(a, dtype=torch.float32) for a in (qd, truth, SCALE))

    def loss() -> Any:
        torque = network(torch.zeros_like(speeds), speeds, torch.sign(speeds))
        return ((torque - target) / scale).square().mean()

    descend(network, loss, 2e-2, 300)
    error = np.sqrt(np.mean((network.curve(qd) - truth) ** 2, axis=0))
    assert np.all(error < 0.02 * SCALE)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"unit": 0.0}, "unit is 0.0"),
        ({"speed_bounds": [0.3, 0.02]}, "the first must be below"),
        ({"start_speed": 0.5}, "start_speed is 0.5, but must be between 0.02 and 0.3"),
        ({"hidden": [0]}, "hidden is 0"),
        ({"sign": "soft"}, "sign is 'soft'"),
        ({"ofset": False}, "no parameter 'ofset'"),
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(settings: dict[str, Any], told: str) -> None:
    with pytest.raises(SpecError, match=told):
        FrictionSettings.given(settings)


def test_an_unknown_friction_is_refused_by_name() -> None:
    with pytest.raises(SpecError, match="friction is 'stribek'"):
        friction_network("stribek", 3, SCALE)  # type: ignore[arg-type]
