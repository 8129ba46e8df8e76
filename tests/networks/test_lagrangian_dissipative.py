"""Friction learned by networks of their own: dissipative, and as published."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hil.networks.lagrangian_settings import FrictionSettings

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.lagrangian_friction import friction_network  # noqa: E402

SCALE = np.array([22.0, 4.0, 0.5])


def moved(kind: str, seed: int) -> Any:
    """A network in double precision, far from where it starts."""
    network = friction_network(kind, 3, SCALE, seed=seed).double()  # type: ignore[arg-type]
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=random, dtype=torch.float64))
    return network


def motion(count: int = 400) -> tuple[Any, Any]:
    random = np.random.default_rng(5)
    q, qd = random.uniform(-3.0, 3.0, size=(count, 3)), random.normal(size=(count, 3))
    return torch.as_tensor(q), torch.as_tensor(qd)


def test_dissipative_friction_never_drives_the_arm() -> None:
    q, qd = motion()
    for seed in range(5):
        torque = moved("dissipative", seed)(q, qd, torch.sign(qd))
        assert bool(((torque * qd).sum(dim=1) >= 0.0).all())


def test_unconstrained_friction_can_drive_the_arm() -> None:
    q, qd = motion()
    torque = moved("unconstrained", 0)(q, qd, torch.sign(qd))
    assert bool(((torque * qd).sum(dim=1) < 0.0).any())


def test_the_damping_matrix_is_symmetric_without_negative_eigenvalues() -> None:
    q, qd = motion()
    D = moved("dissipative", 3).damping(q, qd).detach().numpy()
    np.testing.assert_array_equal(D, np.swapaxes(D, 1, 2))
    eigenvalues = np.linalg.eigvalsh(D)
    assert np.all(eigenvalues >= -1e-12 * eigenvalues.max())


def test_dissipative_torque_is_the_damping_matrix_times_velocity() -> None:
    q, qd = motion()
    network = moved("dissipative", 2)
    expected = np.einsum("bij,bj->bi", network.damping(q, qd).detach().numpy(), qd.numpy())
    torque = network(q, qd, torch.sign(qd)).detach().numpy()
    np.testing.assert_allclose(torque, expected, rtol=1e-10, atol=1e-10)


def test_dissipative_friction_starts_as_coulomb_friction_of_a_share_of_each_joints_torque() -> None:
    curve = friction_network("dissipative", 3, SCALE).curve(np.array([[0.1], [1.0]]) * np.ones(3))
    np.testing.assert_allclose(curve / SCALE, 0.3, atol=0.25)


def test_dissipative_friction_comes_up_over_the_width_of_the_smooth_sign() -> None:
    for width in (0.01, 0.1):
        network = friction_network("dissipative", 3, SCALE, FrictionSettings(rest_speed=width))
        with torch.no_grad():
            network.network[-1].weight.zero_()
        speeds = width * np.array([[1 / 99], [1], [99]]) * np.ones(3)
        slow, half, fast = network.curve(speeds)
        np.testing.assert_allclose(half / fast, 0.5 / 0.99, rtol=1e-4)
        np.testing.assert_allclose(slow / fast, 0.01 / 0.99, rtol=1e-4)


def test_dissipative_friction_is_finite_at_rest_with_a_hard_sign() -> None:
    network = friction_network("dissipative", 3, SCALE, FrictionSettings(rest_speed=0.0))
    still = torch.zeros(1, 3)
    torque = network(still, still, still)
    torque.sum().backward()
    assert not torque.any()
    assert all(bool(torch.isfinite(p.grad).all()) for p in network.parameters())


def test_the_paper_has_no_scale_for_each_joint() -> None:
    q, qd = motion()
    for kind in ("dissipative", "unconstrained"):
        literal = FrictionSettings.literal()
        torques = [
            friction_network(kind, 3, scale, literal)(q.float(), qd.float(), qd.float())  # type: ignore[arg-type]
            for scale in (SCALE, 10.0 * SCALE)
        ]
        assert torch.equal(*torques)


@pytest.mark.parametrize("kind", ["dissipative", "unconstrained"])
def test_the_seed_alone_decides_the_start_weights(kind: str) -> None:
    def weights(seed: int) -> Any:
        network = friction_network(kind, 3, SCALE, seed=seed)  # type: ignore[arg-type]
        return torch.cat([p.detach().flatten() for p in network.parameters()])

    torch.manual_seed(1)
    first = weights(4)
    torch.manual_seed(2)
    assert torch.equal(first, weights(4))
    assert not torch.equal(first, weights(5))


def test_making_a_network_leaves_the_random_numbers_of_others_alone() -> None:
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    friction_network("unconstrained", 3, SCALE, seed=1)
    assert torch.equal(torch.rand(3), expected)


def test_the_curve_of_a_network_is_that_of_one_joint_moving_alone() -> None:
    network = moved("dissipative", 1)
    speeds = np.array([[0.5, 1.0, -2.0]])
    curve = network.curve(speeds)
    for joint in range(3):
        qd = torch.zeros(1, 3, dtype=torch.float64)
        qd[0, joint] = speeds[0, joint]
        alone = network(torch.zeros_like(qd), qd, torch.sign(qd)).detach().numpy()
        assert curve[0, joint] == pytest.approx(alone[0, joint])


def test_no_friction_is_none() -> None:
    q, qd = motion()
    network = friction_network("none", 3, SCALE)
    assert not network(q, qd, torch.sign(qd)).any()
    assert not network.curve(qd.numpy()).any()
    assert list(network.parameters()) == []


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["coulomb", "stribeck", "dissipative", "unconstrained"])
def test_friction_can_be_traced_for_export(kind: str) -> None:
    network = friction_network(kind, 3, SCALE).double()  # type: ignore[arg-type]
    q, qd = motion()
    inputs = (q, qd, torch.tanh(qd / 0.01))
    exported = torch.export.export(network, inputs)
    torch.testing.assert_close(exported.module()(*inputs), network(*inputs))
