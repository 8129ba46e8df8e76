"""Friction of Lagrangian networks: intrinsic parameters, learned networks, direction of motion."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.data import Conditions
from hil.data.filters import FilterSettings, prepare
from hil.networks.lagrangian_data import (
    LENGTHS_RAD,
    carried_directions,
    fitted_lengths,
    smooth_sign,
)
from hil.networks.lagrangian_settings import FRICTIONS, FrictionSettings
from tests.support.synthetic_memory import dahl_loop, stopping
from tests.support.synthetic_motion import COULOMB, GAINS, OFFSET, VISCOUS, dataset, nominal, plant

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.lagrangian_friction import friction_network  # noqa: E402

# Coulomb–viscous and Stribeck with intrinsic parameters

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
        ({"speed_bounds": [0.3, 0.02]}, "the first number must be below"),
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


# Networks of their own: dissipative, and as published


def learned(kind: str, seed: int) -> Any:
    """A network in double precision, far from where it starts."""
    network = friction_network(kind, 3, SCALE, seed=seed).double()  # type: ignore[arg-type]
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=random, dtype=torch.float64))
    return network


def even_motion(count: int = 400) -> tuple[Any, Any]:
    random = np.random.default_rng(5)
    q, qd = random.uniform(-3.0, 3.0, size=(count, 3)), random.normal(size=(count, 3))
    return torch.as_tensor(q), torch.as_tensor(qd)


def test_dissipative_friction_never_drives_the_arm() -> None:
    q, qd = even_motion()
    for seed in range(5):
        torque = learned("dissipative", seed)(q, qd, torch.sign(qd))
        assert bool(((torque * qd).sum(dim=1) >= 0.0).all())


def test_unconstrained_friction_can_drive_the_arm() -> None:
    q, qd = even_motion()
    torque = learned("unconstrained", 0)(q, qd, torch.sign(qd))
    assert bool(((torque * qd).sum(dim=1) < 0.0).any())


def test_the_damping_matrix_is_symmetric_without_negative_eigenvalues() -> None:
    q, qd = even_motion()
    D = learned("dissipative", 3).damping(q, qd).detach().numpy()
    np.testing.assert_array_equal(D, np.swapaxes(D, 1, 2))
    eigenvalues = np.linalg.eigvalsh(D)
    assert np.all(eigenvalues >= -1e-12 * eigenvalues.max())


def test_dissipative_torque_is_the_damping_matrix_times_velocity() -> None:
    q, qd = even_motion()
    network = learned("dissipative", 2)
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
    q, qd = even_motion()
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
    network = learned("dissipative", 1)
    speeds = np.array([[0.5, 1.0, -2.0]])
    curve = network.curve(speeds)
    for joint in range(3):
        qd = torch.zeros(1, 3, dtype=torch.float64)
        qd[0, joint] = speeds[0, joint]
        alone = network(torch.zeros_like(qd), qd, torch.sign(qd)).detach().numpy()
        assert curve[0, joint] == pytest.approx(alone[0, joint])


def test_no_friction_is_none() -> None:
    q, qd = even_motion()
    network = friction_network("none", 3, SCALE)
    assert not network(q, qd, torch.sign(qd)).any()
    assert not network.curve(qd.numpy()).any()
    assert list(network.parameters()) == []


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["coulomb", "stribeck", "dissipative", "unconstrained"])
def test_friction_can_be_traced_for_export(kind: str) -> None:
    network = friction_network(kind, 3, SCALE).double()  # type: ignore[arg-type]
    q, qd = even_motion()
    inputs = (q, qd, torch.tanh(qd / 0.01))
    exported = torch.export.export(network, inputs)
    torch.testing.assert_close(exported.module()(*inputs), network(*inputs))


# Dahl's state in place of sign(qd)


def remembering_motion(length, *seeds, noise_nm=0.05):
    """Rigid body, Dahl friction of one length per joint, viscous friction; prepared."""
    columns, conditions = {}, []
    for seed in seeds:
        t, q, qd, qdd = stopping(seed)
        torque = plant().inverse_dynamics(q, qd, qdd) + dahl_loop(q, length) * COULOMB
        torque += VISCOUS * qd + OFFSET
        torque += noise_nm * np.random.default_rng(seed).normal(size=torque.shape)
        for name, values in {"t": t, "q": q, "qd": qd, "effort": torque / GAINS}.items():
            columns.setdefault(name, []).append(values)
        conditions.append(Conditions(f"t{seed}", "trajectory", f"run{seed}", seed))
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    data = dataset(joined, [len(columns["t"][0])] * len(seeds), conditions)
    exact = {"q_f": joined["q"], "qd_f": joined["qd"], "qdd_f": np.zeros_like(joined["q"])}
    exact["qdd_f"] = prepare(data, FilterSettings())["qdd_f"]
    return data.with_columns(**exact, effort_f=joined["effort"])


def test_the_length_of_every_joint_is_found() -> None:
    length = LENGTHS_RAD[[7, 8, 9, 7, 8, 9]]
    data = remembering_motion(length, 1)
    torque, rows = data["effort"] * GAINS, np.arange(len(data))
    assert np.array_equal(fitted_lengths(data, torque, rows, nominal()), length)


def test_states_begin_afresh_with_every_series() -> None:
    length = np.full(6, 3e-3)
    both, second = remembering_motion(length, 1, 2), remembering_motion(length, 2)
    states = carried_directions(both, length)
    assert np.array_equal(states[len(second) :], carried_directions(second, length))
    assert np.array_equal(states[len(second)], np.zeros(6))


def test_states_are_dahls_equation_along_the_path() -> None:
    data = remembering_motion(np.full(6, 3e-3), 3)
    loop = dahl_loop(data["q"], 3e-3)
    # The path is summed up from velocities: a little off where joints turn round.
    assert np.sqrt(np.mean((carried_directions(data, np.full(6, 3e-3)) - loop) ** 2)) < 0.02


def test_the_smooth_sign_of_width_zero_is_the_sign() -> None:
    speeds = np.array([[-2.0, -1e-9, 0.0, 1e-9, 2.0]])
    assert np.array_equal(smooth_sign(speeds, 0.0), np.sign(speeds))
    assert np.allclose(smooth_sign(speeds, 0.01), [[-1.0, -1e-7, 0.0, 1e-7, 1.0]])
