"""The Lagrangian network against torch.func, Pinocchio and its own promises."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
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


# What becomes of it when torch writes it down


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["ours", "literal"])
def test_an_exported_network_takes_any_number_of_rows(name) -> None:
    net = network(SETTINGS[name])
    rows = torch.export.Dim("rows", min=1)
    exported = torch.export.export(net, tuple(motion(5)), dynamic_shapes=({0: rows},) * 3)
    other = motion(9, seed=1)
    torch.testing.assert_close(exported.module()(*other), net(*other), rtol=1e-12, atol=0.0)


def test_the_exported_graph_neither_indexes_nor_branches() -> None:
    """What scatters, gathers or selects is what small targets lack."""
    graph = torch.export.export(network(SETTINGS["ours"]), tuple(motion(5))).graph
    used = {str(node.target) for node in graph.nodes if node.op == "call_function"}
    assert not [name for name in used if any(w in name for w in ("index", "gather", "scatter"))]
    assert not [name for name in used if any(w in name for w in ("where", "grad", "cond"))]


# A known arm, a point mass on a pan and a tilt joint, against Pinocchio

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
def pan_tilt_rows():
    random = np.random.default_rng(1)
    return [random.uniform(-size, size, (50, 2)) for size in (np.pi, 3.0, 8.0)]


def torques(function, pan_tilt_rows):
    return np.array([function(*row) for row in zip(*pan_tilt_rows, strict=True)])


@pytest.mark.parametrize("gravity", ["potential", "head"])
def test_torque_equals_pinocchios(pan_tilt, pan_tilt_rows, gravity) -> None:
    data = pan_tilt.createData()
    expected = torques(lambda *row: pin.rnea(pan_tilt, data, *row), pan_tilt_rows)
    found = by_hand(gravity)(*map(torch.as_tensor, pan_tilt_rows)).detach().numpy()
    assert found == pytest.approx(expected, abs=1e-11)


def test_mass_matrix_equals_pinocchios(pan_tilt, pan_tilt_rows) -> None:
    data = pan_tilt.createData()
    expected = np.array([pin.crba(pan_tilt, data, q) for q in pan_tilt_rows[0]])
    found = by_hand("potential").mass(torch.as_tensor(pan_tilt_rows[0])).detach().numpy()
    assert found == pytest.approx(expected, abs=1e-12)


def test_coriolis_torque_equals_pinocchios(pan_tilt, pan_tilt_rows) -> None:
    data = pan_tilt.createData()
    q, qd, _ = pan_tilt_rows
    expected = np.array(
        [
            pin.computeCoriolisMatrix(pan_tilt, data, *row) @ row[1]
            for row in zip(q, qd, strict=True)
        ]
    )
    found = (
        by_hand("potential").parts(*map(torch.as_tensor, pan_tilt_rows)).coriolis.detach().numpy()
    )
    assert found == pytest.approx(expected, abs=1e-11)


def test_gravity_torque_equals_pinocchios(pan_tilt, pan_tilt_rows) -> None:
    data = pan_tilt.createData()
    expected = np.array(
        [pin.computeGeneralizedGravity(pan_tilt, data, q) for q in pan_tilt_rows[0]]
    )
    found = (
        by_hand("potential").parts(*map(torch.as_tensor, pan_tilt_rows)).gravity.detach().numpy()
    )
    assert found == pytest.approx(expected, abs=1e-11)
