"""The Lagrangian network against derivatives by torch.func, and against its own promises."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.core.errors import SpecError  # noqa: E402
from hil.estimators.parameters import settings as read_settings  # noqa: E402
from hil.networks.lagrangian import LagrangianNetwork, softplus  # noqa: E402
from hil.networks.lagrangian_settings import NetworkSettings  # noqa: E402
from tests.support.lagrangian_reference import SCALE, SETTINGS, Reference, motion, network  # noqa: E402

pytestmark = pytest.mark.filterwarnings(  # torch.func.jvp itself, when it is first used
    "ignore:.torch.jit.script. is deprecated:DeprecationWarning"
)
CASES = pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
SMALL = NetworkSettings(hidden=(8,))


def close(found, expected, tolerance=1e-10):
    """Relative to the largest number expected."""
    away = (found - expected).abs().max().item()
    return away <= tolerance * max(1.0, expected.abs().max().item())


@CASES
def test_torque_equals_euler_lagrange_by_torch_func(settings) -> None:
    net, rows = network(settings), motion(8)
    assert close(net(*rows), Reference(net, settings).rows("torque", *rows))


@CASES
def test_parts_add_up_to_the_torque(settings) -> None:
    net, rows = network(settings), motion(8)
    parts = net.parts(*rows)
    assert close(parts.inertia + parts.coriolis + parts.gravity, net(*rows))


@CASES
def test_mass_matrix_equals_the_factor_filled_by_hand(settings) -> None:
    net, (q, qd, qdd) = network(settings), motion(8)
    expected = Reference(net, settings).rows("mass", q)
    assert close(net.mass(q), expected)
    assert close(net.parts(q, qd, qdd).mass, expected)


@CASES
def test_inertia_is_the_mass_matrix_times_acceleration(settings) -> None:
    net, (q, qd, qdd) = network(settings), motion(8)
    expected = torch.einsum("Bij,Bj->Bi", net.mass(q), qdd)
    assert close(net.parts(q, qd, qdd).inertia, expected)


@CASES
def test_coriolis_equals_christoffels_symbols(settings) -> None:
    net, (q, qd, qdd) = network(settings), motion(8)
    expected = Reference(net, settings).rows("coriolis", q, qd)
    assert close(net.parts(q, qd, qdd).coriolis, expected)


@CASES
def test_gravity_equals_the_gradient_of_the_potential_or_the_head(settings) -> None:
    net, (q, qd, qdd) = network(settings), motion(8)
    assert close(net.parts(q, qd, qdd).gravity, Reference(net, settings).rows("gravity", q))


@CASES
def test_coriolis_does_half_the_work_of_the_changing_mass(settings) -> None:
    """q̇ᵀ(Ṁ − 2C)q̇ = 0, with Ṁ by finite differences."""
    net, (q, qd, qdd) = network(settings), motion(8)
    step = 1e-6
    rate = (net.mass(q + step * qd) - net.mass(q - step * qd)) / (2 * step)
    work = (qd * net.parts(q, qd, qdd).coriolis).sum(-1)
    assert close(work, 0.5 * torch.einsum("Bi,Bij,Bj->B", qd, rate, qd), 1e-6)


@CASES
def test_mass_matrix_is_symmetric_and_positive_definite_anywhere(settings) -> None:
    M = network(settings).mass(10.0 * motion(500)[0])
    assert torch.equal(M, M.mT)
    assert torch.linalg.eigvalsh(M).min() > 0.0


def test_mass_matrix_is_positive_definite_where_the_diagonal_has_died() -> None:
    net = network(SETTINGS["literal"])
    with torch.no_grad():
        net.trunk.last.bias[:6] = -1e3
    least = torch.linalg.eigvalsh(net.mass(motion(50)[0])).min()
    assert least.item() == pytest.approx(SETTINGS["literal"].epsilon, rel=1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["ours", "silu-head", "literal"])
def test_gradient_by_every_weight_equals_finite_differences(name) -> None:
    settings = SETTINGS[name].model_copy(update={"hidden": (5, 4)})
    net, rows = network(settings, n=2), motion(3, n=2)
    names, values = zip(*net.named_parameters(), strict=True)

    def torque(*weights):
        return torch.func.functional_call(net, dict(zip(names, weights, strict=True)), rows)

    assert torch.autograd.gradcheck(torque, values, eps=1e-6, atol=1e-5)


def test_softplus_and_its_slope_agree_far_from_zero() -> None:
    """torch's own softplus leaves out e⁻²¹ at 21, and the slope does not."""
    x = torch.linspace(-50.0, 60.0, 221, dtype=torch.float64)
    value, slope = softplus(x)
    assert value.numpy() == pytest.approx(np.logaddexp(x.numpy(), 0.0), rel=1e-15, abs=0.0)
    assert slope.numpy() == pytest.approx(expit(x.numpy()), rel=1e-14, abs=0.0)


def test_single_precision_is_as_close_as_it_can_be() -> None:
    net, rows = LagrangianNetwork(6, NetworkSettings(), SCALE, 1), motion(100)
    single = net(*(x.float() for x in rows)).double()
    assert close(single, net.double()(*rows), 2e-5)


def test_every_row_is_computed_by_itself() -> None:
    net, rows = network(SETTINGS["ours"]), motion(7)
    alone = torch.cat([net(*(x[i : i + 1] for x in rows)) for i in range(7)])
    assert close(net(*rows), alone, 1e-13)


def test_a_whole_turn_changes_nothing() -> None:
    net, (q, qd, qdd) = network(SETTINGS["ours"]), motion(8)
    turned = q + 2 * torch.pi * torch.tensor([1.0, -1.0, 2.0, 0.0, 0.0, 1.0], dtype=q.dtype)
    assert close(net(turned, qd, qdd), net(q, qd, qdd), 1e-12)


def test_torque_grows_with_the_scale_it_is_given() -> None:
    q, qd, qdd = motion(8)
    small = LagrangianNetwork(6, SMALL, SCALE, 5).double()
    large = LagrangianNetwork(6, SMALL, [4.0 * s for s in SCALE], 5).double()
    assert close(large(q, qd, qdd), 4.0 * small(q, qd, qdd))


def test_the_start_gives_every_joint_inertia_of_its_own_size() -> None:
    net = LagrangianNetwork(6, NetworkSettings(), SCALE, 0)
    relative = net.mass(motion(200)[0].float()).diagonal(dim1=1, dim2=2).mean(0) / torch.tensor(
        SCALE
    )
    assert relative.max() / relative.min() < 2.0


def test_the_same_seed_starts_the_same_and_another_does_not() -> None:
    first, again, other = (
        LagrangianNetwork(6, SMALL, SCALE, seed).trunk.last.weight for seed in (4, 4, 5)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_building_a_network_leaves_the_global_generator_alone() -> None:
    before = torch.get_rng_state()
    LagrangianNetwork(6, SMALL)
    assert torch.equal(torch.get_rng_state(), before)


def test_state_dict_holds_weights_and_nothing_else() -> None:
    net = LagrangianNetwork(6, SMALL, SCALE)
    assert set(net.state_dict()) == {name for name, _ in net.named_parameters()}


@pytest.mark.parametrize("scale", [[1.0] * 5, [1.0] * 5 + [0.0], [1.0] * 5 + [np.nan]])
def test_a_torque_scale_that_is_none_is_refused(scale) -> None:
    with pytest.raises(SpecError, match="6 numbers above zero"):
        LagrangianNetwork(6, SMALL, scale)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"activation": "gelu"}, "network.activation"),
        ({"hidden": []}, "network.hidden"),
        ({"hidden": [0]}, "network.hidden.0"),
        ({"epsilon": -1.0}, "network.epsilon"),
        ({"width": 64}, "network has no parameter 'width'"),
    ],
)
def test_settings_nobody_knows_are_told_by_name(given, told) -> None:
    with pytest.raises(SpecError, match=told):
        read_settings("network", given, NetworkSettings)


def test_literal_settings_are_the_papers() -> None:
    literal = NetworkSettings.literal()
    assert (literal.hidden, literal.activation) == ((128, 128, 128), "relu")
    assert (literal.gravity, literal.diagonal, literal.features) == ("head", "relu", "raw")
    assert not literal.scaled
