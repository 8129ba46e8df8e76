"""Networks and their derivative, against finite differences, pyrenn and torch."""

import warnings

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.networks.mlp import Mlp, NumpyArrays

PAPER = ("linear", "tanh", "tanh", "linear")
LAYOUTS = [
    Mlp((4, 20, 20, 10, 1)),
    Mlp((4, 6, 5, 3, 1), PAPER),
    Mlp((2, 3, 1), ("tanh", "tanh")),
    Mlp((3, 1)),
]


def weights_and_inputs(mlp, networks=2, rows=15):
    random = np.random.default_rng(3)
    weights = np.stack([mlp.initial(1, b) for b in range(networks)])
    return weights, random.normal(size=(rows, mlp.inputs))


def differences(mlp, weights, X, step=1e-5):
    """(B, N, P) derivative by central differences of fourth order."""
    out = []
    for p in range(mlp.n_weights):
        e = step * np.eye(mlp.n_weights)[p]
        f = [mlp.predict(weights + k * e, X) for k in (-2, -1, 1, 2)]
        out.append((f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * step))
    return np.stack(out, axis=-1)


@pytest.mark.parametrize("mlp", LAYOUTS, ids=str)
def test_jacobian_equals_finite_differences(mlp) -> None:
    weights, X = weights_and_inputs(mlp)
    assert mlp.jacobian(weights, X) == pytest.approx(differences(mlp, weights, X), abs=1e-9)


def test_networks_may_have_inputs_of_their_own() -> None:
    mlp = LAYOUTS[1]
    weights, X = weights_and_inputs(mlp)
    own = np.stack([X, 2 * X])
    assert mlp.predict(weights, own)[1] == pytest.approx(mlp.predict(weights, 2 * X)[1])
    assert mlp.jacobian(weights, own)[1] == pytest.approx(mlp.jacobian(weights, 2 * X)[1])


@pytest.fixture(scope="module")
def pyrenn():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip("pyrenn", reason="pyrenn is not installed")


def test_output_and_jacobian_equal_pyrenns_in_the_same_order(pyrenn) -> None:
    mlp = Mlp((4, 20, 20, 10, 1))
    weights, X = weights_and_inputs(mlp, networks=1)
    X = X / np.abs(X).max()  # pyrenn scales what exceeds 1
    net = pyrenn.CreateNN([4, 20, 20, 10, 1])
    net["w"] = weights[0]
    data, net = pyrenn.prepare_data(X.T, np.zeros((1, len(X))), net)
    J, cost, _ = pyrenn.RTRL(net, data)
    assert mlp.jacobian(weights, X)[0] == pytest.approx(-J, abs=1e-12)
    assert np.sum(mlp.predict(weights, X) ** 2) == pytest.approx(cost)


def test_jacobian_equals_torchs() -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    mlp = Mlp((4, 6, 5, 3, 1), PAPER)
    weights, X = weights_and_inputs(mlp, networks=1)

    def output(vector):
        value, start = torch.as_tensor(X), 0
        for (rows, units), kind in zip(mlp.shapes, PAPER, strict=True):
            matrix = vector[start : start + rows * units].reshape(rows, units)
            value, start = value @ matrix[:-1] + matrix[-1], start + rows * units
            value = torch.tanh(value) if kind == "tanh" else value
        return value[:, 0]

    J = torch.autograd.functional.jacobian(output, torch.as_tensor(weights[0]))
    assert mlp.jacobian(weights, X)[0] == pytest.approx(J.numpy(), abs=1e-12)


@pytest.mark.parametrize("rows", [5, 700])
def test_products_from_the_factors_equal_those_of_the_jacobian(rows) -> None:
    """More rows than one piece of the Jacobian and one block of the kernel hold."""
    mlp, arrays = Mlp((4, 6, 5, 3, 1), PAPER), NumpyArrays("float64")
    weights, X = weights_and_inputs(mlp, rows=rows)
    at = mlp.forward(weights, arrays.inputs(X), arrays).linearised()
    J, random = mlp.jacobian(weights, X), np.random.default_rng(0)
    v, u = random.normal(size=(2, rows)), random.normal(size=weights.shape)
    assert at.transposed_times(v) == pytest.approx(np.einsum("bnp,bn->bp", J, v))
    assert at.times(mlp.matrices(u)) == pytest.approx(np.einsum("bnp,bp->bn", J, u))
    lower = np.tri(mlp.n_weights, dtype=bool), np.tri(rows, dtype=bool)
    normal, kernel = J.swapaxes(1, 2) @ J, J @ J.swapaxes(1, 2)
    assert np.allclose(at.normal_matrix()[:, lower[0]], normal[:, lower[0]], rtol=1e-9)
    assert np.allclose(at.kernel()[:, lower[1]], kernel[:, lower[1]], rtol=1e-9)


def test_the_papers_network_has_741_weights() -> None:
    assert Mlp((4, 20, 20, 10, 1)).n_weights == 741


def test_units_start_with_sums_of_variance_one() -> None:
    mlp = Mlp((50, 400, 1))
    W = mlp.matrices(mlp.initial(0)[None])[0][0]
    inputs = np.column_stack([np.random.default_rng(1).normal(size=(500, 50)), np.ones(500)])
    assert np.var(inputs @ W) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(
    ("layers", "activations", "told"),
    [
        ([4], None, "at least two"),
        ([4, 0, 1], None, "positive"),
        ([4, 2.5, 1], None, "whole"),
        ("4-1", None, "list"),
        ([4, 5, 2], None, "one output"),
        ([4, 5, 1], ["tanh"], "2 words"),
        ([4, 5, 1], ["relu", "linear"], "tanh or linear"),
    ],
)
def test_what_is_no_network_is_refused(layers, activations, told) -> None:
    with pytest.raises(SpecError, match=told):
        Mlp(layers, activations)
