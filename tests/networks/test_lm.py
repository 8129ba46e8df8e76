"""Networks trained by Levenberg–Marquardt: derivatives, steps, stops, and the regressor."""

from __future__ import annotations

import subprocess
import sys
import warnings

import numpy as np
import pytest
from sklearn.model_selection import cross_val_score
from sklearn.utils.estimator_checks import check_estimator

from hil.core.errors import FitError, SpecError
from hil.networks.lm import (
    ConstantInputWarning,
    Damping,
    Dual,
    Primal,
    averaged,
    checked_rows,
    dual_is_faster,
    equal_inputs,
    train,
)
from hil.networks.lm_regressor import LevenbergMarquardtRegressor
from hil.networks.mlp import Mlp, NumpyArrays

# The network and its derivative, against finite differences, pyrenn and torch

LITERAL = ("linear", "tanh", "tanh", "linear")
LAYOUTS = [
    Mlp((4, 20, 20, 10, 1)),
    Mlp((4, 6, 5, 3, 1), LITERAL),
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


@pytest.mark.parametrize(
    "mlp", [pytest.param(LAYOUTS[0], marks=pytest.mark.thorough), *LAYOUTS[1:]], ids=str
)
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
    mlp = Mlp((4, 6, 5, 3, 1), LITERAL)
    weights, X = weights_and_inputs(mlp, networks=1)

    def output(vector):
        value, start = torch.as_tensor(X), 0
        for (rows, units), kind in zip(mlp.shapes, LITERAL, strict=True):
            matrix = vector[start : start + rows * units].reshape(rows, units)
            value, start = value @ matrix[:-1] + matrix[-1], start + rows * units
            value = torch.tanh(value) if kind == "tanh" else value
        return value[:, 0]

    J = torch.autograd.functional.jacobian(output, torch.as_tensor(weights[0]))
    assert mlp.jacobian(weights, X)[0] == pytest.approx(J.numpy(), abs=1e-12)


@pytest.mark.parametrize("rows", [5, 700])
def test_products_from_the_factors_equal_those_of_the_jacobian(rows) -> None:
    """More rows than one piece of the Jacobian and one block of the kernel hold."""
    mlp, arrays = Mlp((4, 6, 5, 3, 1), LITERAL), NumpyArrays("float64")
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
        ([4, 5, 1], ["tanh"], "2 entries"),
        ([4, 5, 1], ["relu", "linear"], "tanh or linear"),
    ],
)
def test_what_is_no_network_is_refused(layers, activations, told) -> None:
    with pytest.raises(SpecError, match=told):
        Mlp(layers, activations)


# Training, on small problems whose answer is known

MLP = Mlp((2, 8, 6, 1))


def surface(rows=120, seed=0, noise=0.0):
    """Two smooth functions of two inputs, in odd units."""
    random = np.random.default_rng(seed)
    X = random.uniform(-1.0, 1.0, (rows, 2)) * [3.0, 0.01] + [1.0, 5.0]
    a, b = (X[:, 0] - 1.0) / 3.0, (X[:, 1] - 5.0) / 0.01
    Y = np.column_stack([40 + 7 * np.tanh(2 * a * b), 1e-3 * (np.sin(2 * a) + b)])
    return X, Y + noise * Y.std(axis=0) * random.normal(size=Y.shape)


def repeated(times=5, rows=30, noise=0.3):
    """Every input `times` over, the target with noise."""
    X, Y = surface(rows)
    pose = np.repeat(np.arange(rows), times)
    random = np.random.default_rng(4)
    return X[pose], Y[pose] + noise * Y.std(axis=0) * random.normal(size=(len(pose), 2)), pose


def relative(errors, Y):
    return np.sqrt(np.mean(errors**2, axis=0)) / Y.std(axis=0)


def test_known_functions_are_learnt_and_generalise() -> None:
    trained = train(MLP, *surface(), epochs=200)
    X, Y = surface(seed=7)
    assert np.all(relative(trained.predict(X) - Y, Y) < 5e-3)


def test_training_error_never_rises() -> None:
    for history in train(MLP, *surface(noise=0.2), epochs=60).histories:
        assert history.epochs > 20
        assert np.all(np.diff(history.train_rmse) < 0)


def test_reported_error_is_that_of_the_predictions_on_all_rows() -> None:
    X, Y, pose = repeated()
    for groups in (None, pose):
        trained = train(MLP, X, Y, groups=groups, epochs=15)
        told = [history.final_train_rmse for history in trained.histories]
        assert told == pytest.approx(np.sqrt(np.mean((trained.predict(X) - Y) ** 2, axis=0)))


def gradient(weights, rows):
    """JᵀWr of the mean square error, from the Jacobian written out."""
    J = MLP.jacobian(weights, rows.X)
    residual = rows.Y.T - MLP.predict(weights, rows.X)
    return np.einsum("bnp,bn->bp", J, rows.weight * residual)


def test_averaged_rows_have_the_gradient_of_all() -> None:
    X, Y, pose = repeated()
    weight = np.random.default_rng(1).uniform(0.0, 2.0, len(X))
    weights = np.stack([MLP.initial(2, b) for b in range(2)])
    every = checked_rows(X, Y, weight)
    mean = checked_rows(X, Y, weight, pose)
    assert len(mean) == 30
    assert gradient(weights, mean) == pytest.approx(gradient(weights, every), rel=1e-10)


def test_averaging_changes_no_step() -> None:
    """While rounding has not yet grown: LM amplifies it by the condition of JᵀJ."""
    X, Y, pose = repeated()
    every, mean = (train(MLP, X, Y, groups=g, epochs=12) for g in (None, pose))
    for a, b in zip(every.histories, mean.histories, strict=True):
        assert a.train_rmse == pytest.approx(b.train_rmse, rel=1e-6)


def test_averaging_does_not_depend_on_the_order_of_rows() -> None:
    X, Y, pose = repeated()
    order = np.random.default_rng(0).permutation(len(X))
    weight = np.full(len(X), 1.0 / len(X))
    one = averaged(X[None], Y, weight, pose)
    other = averaged(X[None, order], Y[order], weight, pose[order])
    for a, b in zip(one, other, strict=True):
        assert a == pytest.approx(b)


def test_rows_whose_inputs_differ_are_not_averaged() -> None:
    X, Y, pose = repeated()
    X[:, 1] = np.random.default_rng(0).normal(size=len(X))
    with pytest.raises(FitError, match="input 2 of 2 is not constant within the groups"):
        train(MLP, X, Y, groups=pose, epochs=2)
    own = np.stack([repeated()[0], X])
    with pytest.raises(FitError, match="input 2 of 2"):
        train(MLP, own, Y, groups=pose, epochs=2)


def test_validation_rows_whose_inputs_differ_are_not_averaged() -> None:
    X, Y, pose = repeated()
    astray = X + np.std(X, axis=0) * np.random.default_rng(0).normal(size=X.shape)
    with pytest.raises(FitError, match="is not constant within the groups"):
        train(MLP, X, Y, groups=pose, validation=(astray, Y, None, pose), epochs=2)


def test_noise_of_the_inputs_may_be_averaged_even_where_there_is_one_pose() -> None:
    X, Y, pose = repeated()
    X = X + 1e-3 * np.std(X, axis=0) * np.random.default_rng(0).normal(size=X.shape)
    one = pose < 1
    labels = np.arange(int(one.sum())) % 2
    trained = train(MLP, X, Y, groups=pose, validation=(X[one], Y[one], None, labels), epochs=2)
    told = [history.final_train_rmse for history in trained.histories]
    assert told == pytest.approx(np.sqrt(np.mean((trained.predict(X) - Y) ** 2, axis=0)), rel=0.01)


def test_equal_inputs_find_the_groups() -> None:
    X, _, pose = repeated()
    found = equal_inputs(X)
    assert len(set(zip(found.tolist(), pose.tolist(), strict=True))) == 30
    assert len(set(equal_inputs(np.stack([X, X + np.arange(len(X))[:, None]])))) == len(X)


def test_a_weight_counts_as_so_many_rows() -> None:
    X, Y = surface(40)
    times = np.random.default_rng(0).integers(1, 4, 40)
    weighted = train(MLP, X, Y, times.astype(float), epochs=8)
    written_out = train(MLP, np.repeat(X, times, axis=0), np.repeat(Y, times, axis=0), epochs=8)
    assert weighted.predict(X) == pytest.approx(written_out.predict(X), rel=1e-6)


@pytest.mark.parametrize("decay", [0.0, 0.02])
def test_dual_step_equals_primal_step(decay) -> None:
    arrays, random = NumpyArrays("float64"), np.random.default_rng(5)
    weights = np.stack([MLP.initial(0, b) for b in range(2)])
    passed = MLP.forward(weights, arrays.inputs(random.normal(size=(20, 2))), arrays)
    at, residual = passed.linearised(random.uniform(0.1, 1.0, 20)), random.normal(size=(2, 20))
    primal = Primal(at, residual, weights, decay, arrays)
    dual = Dual(at, residual, weights, decay, arrays, MLP)
    for damping in (np.array([1e-3, 10.0]), np.array([1.0, 1e-2])):
        expected, solved = primal.step(damping)
        assert solved.all()
        assert dual.step(damping)[0] == pytest.approx(expected, rel=1e-7, abs=1e-12)


def test_step_solves_the_damped_normal_equations() -> None:
    arrays, random = NumpyArrays("float64"), np.random.default_rng(5)
    weights, X = MLP.initial(0)[None], random.normal(size=(200, 2))
    at = MLP.forward(weights, arrays.inputs(X), arrays).linearised()
    residual, decay, damping = random.normal(size=(1, 200)), 0.3, 0.05
    J = MLP.jacobian(weights, X)[0]
    shift = decay + damping * np.trace(J.T @ J) / J.shape[1]
    expected = np.linalg.solve(
        J.T @ J + shift * np.eye(J.shape[1]), J.T @ residual[0] - decay * weights[0]
    )
    step, _ = Primal(at, residual, weights, decay, arrays).step(np.array([damping]))
    assert step[0] == pytest.approx(expected)


def test_dual_is_chosen_when_rows_are_few() -> None:
    paper = Mlp((4, 20, 20, 10, 1))
    assert [dual_is_faster(paper, rows) for rows in (100, 650, 6500)] == [True, True, False]


def test_solvers_end_at_the_same_error() -> None:
    X, Y = surface(60, noise=0.1)
    primal, dual = (train(MLP, X, Y, epochs=10, solver=s) for s in ("primal", "dual"))
    assert primal.predict(X) == pytest.approx(dual.predict(X), rel=1e-5)


def test_float32_is_nearly_as_good() -> None:
    X, Y = surface()
    errors = relative(train(MLP, X, Y, epochs=60, precision="float32").predict(X) - Y, Y)
    assert np.all(errors < 5e-3)


def test_early_stop_keeps_the_weights_of_the_best_validation_error() -> None:
    X, Y = surface(40, noise=0.5)
    X_held, Y_held = surface(200, seed=9)
    trained = train(MLP, X, Y, validation=(X_held, Y_held), patience=10, epochs=300)
    error = np.sqrt(np.mean((trained.predict(X_held) - Y_held) ** 2, axis=0))
    for b, history in enumerate(trained.histories):
        assert history.stopped == "patience"
        assert history.epochs == history.best_epoch + 10
        assert history.best_epoch == np.argmin(history.validation_rmse)
        assert error[b] == pytest.approx(history.validation_rmse.min())


def test_a_validation_error_that_falls_by_next_to_nothing_runs_out_of_patience() -> None:
    X, Y = surface(40)
    creeping = Damping(start=1e10, fall=1.001)
    histories = train(
        MLP, X, Y, validation=(X, Y), patience=5, epochs=30, damping=creeping
    ).histories
    for history in histories:
        fallen = 1.0 - history.validation_rmse[-1] / history.validation_rmse[0]
        assert 0.0 < fallen < 1e-6
        assert (history.stopped, history.epochs) == ("patience", 5)


def test_with_weight_decay_the_training_error_may_rise() -> None:
    X, Y = surface(noise=0.3)
    heavy = [25.0 * MLP.initial(0, b) for b in range(2)]
    histories = train(MLP, X, Y, initial=heavy, weight_decay=0.05, epochs=40).histories
    assert any(np.any(np.diff(history.train_rmse) > 0) for history in histories)


def test_weight_decay_makes_weights_smaller() -> None:
    X, Y = surface(noise=0.3)
    free, held = (train(MLP, X, Y, epochs=60, weight_decay=d).weights for d in (0.0, 0.01))
    assert np.sum(held**2) < 0.2 * np.sum(free**2)


def test_each_network_has_its_own_damping() -> None:
    histories = train(MLP, *surface(noise=0.2), epochs=40).histories
    assert not np.array_equal(histories[0].damping[:30], histories[1].damping[:30])


def test_a_seed_gives_the_same_bits_and_another_seed_others() -> None:
    X, Y = surface()
    first, again, other = (train(MLP, X, Y, epochs=20, seed=s).weights for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.thorough
def test_processes_give_the_same_bits_and_every_epoch() -> None:
    X, Y = surface()
    told = {1: [], 2: []}
    weights = [train(MLP, X, Y, epochs=20, jobs=j, callback=told[j].append).weights for j in told]
    assert np.array_equal(*weights)
    seen = [sorted((e.network, e.epoch, e.train_rmse) for e in told[j]) for j in told]
    assert seen[0] == seen[1]
    assert len(seen[0]) == 2 * 21


@pytest.mark.thorough
def test_a_callback_that_raises_ends_the_processes() -> None:
    def enough(epoch):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(MLP, *surface(), epochs=100_000, jobs=2, callback=enough)


@pytest.mark.thorough
def test_processes_end_when_their_parent_is_killed(tmp_path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(
        "import numpy as np\n"
        "from hil.networks.mlp import Mlp\n"
        "from hil.networks.lm import train\n"
        "def told(epoch):\n"
        "    print(epoch.network, flush=True)\n"
        "if __name__ == '__main__':\n"
        "    X = np.random.default_rng(0).normal(size=(2000, 4))\n"
        "    Y = np.random.default_rng(1).normal(size=(2000, 2))\n"
        "    train(Mlp((4, 6, 1)), X, Y, epochs=10**6, jobs=2, callback=told)\n"
    )
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    parent.stdout.readline()
    parent.kill()
    # The workers hold the other end of the pipe: it closes when the last of them has ended.
    out, _ = parent.communicate(timeout=30)
    assert out == "" or set(out.split()) <= {"0", "1"}


@pytest.mark.thorough
def test_training_ends_at_the_target() -> None:
    history = train(MLP, *surface(), epochs=500, target_rmse=1e-4).histories[1]
    assert history.stopped == "target"
    assert history.train_rmse[-1] <= 1e-4 < history.train_rmse[-2]


def test_at_the_minimum_it_ends_instead_of_searching_for_ever() -> None:
    line = Mlp((1, 1))
    X = np.linspace(0.0, 1.0, 20)[:, None]
    trained = train(line, X, 3 * X[:, 0] + np.cos(40 * X[:, 0]), epochs=10_000)
    expected = np.polyfit(X[:, 0], 3 * X[:, 0] + np.cos(40 * X[:, 0]), 1)
    assert trained.histories[0].stopped == "converged"
    assert trained.predict(np.array([[0.0], [1.0]]))[:, 0] == pytest.approx(
        [expected[1], expected.sum()], abs=1e-6
    )


def test_start_weights_may_be_given() -> None:
    start = np.stack([MLP.initial(5, b) for b in range(2)])
    given = train(MLP, *surface(), initial=start, epochs=3)
    assert np.array_equal(given.weights, train(MLP, *surface(), seed=5, epochs=3).weights)


def test_a_constant_input_is_warned_of_and_harmless() -> None:
    X, Y = surface()
    with_constant = np.column_stack([X, np.full(len(X), 0.1)])
    with pytest.warns(ConstantInputWarning, match="input 3 of 3"):
        trained = train(Mlp((3, 8, 6, 1)), with_constant, Y, epochs=100)
    assert np.all(relative(trained.predict(with_constant) - Y, Y) < 1e-2)


def test_a_constant_target_is_met() -> None:
    X, _ = surface()
    assert train(MLP, X, np.full(len(X), 3.0), epochs=30).predict(X) == pytest.approx(3.0, abs=1e-3)


def bad(change):
    X, Y = surface(20)
    arguments = {"X": X, "Y": Y, "sample_weight": None, "groups": None}
    arguments |= change(X.copy(), Y.copy())
    return arguments


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda X, Y: {"Y": np.where(Y[3] == Y, np.nan, Y)}, "2 of the training targets are NaN"),
        (lambda X, Y: {"X": np.where(X[3, 0] == X, np.inf, X)}, "1 of the training inputs"),
        (lambda X, Y: {"X": X[:1], "Y": Y[:1]}, "not enough"),
        (lambda X, Y: {"groups": np.zeros(20, int)}, "1 training row"),
        (lambda X, Y: {"X": X[:10]}, "incompatible shapes"),
        (lambda X, Y: {"X": X[:, :1]}, "2 inputs, but the data have 1"),
        (lambda X, Y: {"groups": np.arange(3)}, "one label|groups has the shape"),
        (lambda X, Y: {"sample_weight": np.ones(3)}, "sample_weight has the shape"),
        (lambda X, Y: {"sample_weight": np.zeros(20)}, "not zero everywhere"),
        (lambda X, Y: {"sample_weight": np.full(20, -1.0)}, "not negative"),
        (lambda X, Y: {"Y": 1e200 * Y}, "too large"),
    ],
)
def test_data_that_cannot_be_are_refused(change, told) -> None:
    with pytest.raises(FitError, match=told):
        train(MLP, **bad(change))


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"epochs": -1}, "epochs"),
        ({"epochs": 1.5}, "whole"),
        ({"patience": 3}, "validation rows"),
        ({"precision": "float16"}, "precision"),
        ({"solver": "cg"}, "solver"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"jobs": 0}, "jobs"),
        ({"epoch": 10}, "no parameter 'epoch'"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, told) -> None:
    with pytest.raises(SpecError, match=told):
        train(MLP, *surface(), **settings)


def test_damping_that_cannot_be_is_refused() -> None:
    with pytest.raises(SpecError, match=r"damping\.fall"):
        Damping(fall=1.0)


def test_torch_takes_the_same_steps() -> None:
    pytest.importorskip("torch", reason="torch is not installed")
    X, Y = surface(60, noise=0.1)
    for solver in ("primal", "dual"):
        ours = train(MLP, X, Y, epochs=8, solver=solver)
        theirs = train(MLP, X, Y, epochs=8, solver=solver, device="torch-cpu")
        assert theirs.predict(X) == pytest.approx(ours.predict(X), rel=1e-6)


def test_a_missing_device_is_refused() -> None:
    with pytest.raises(SpecError, match=r"torch|device"):
        train(MLP, *surface(), device="cuda:77")


# The regressor keeps scikit-learn's contract


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::hil.networks.lm.ConstantInputWarning")
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.SkipTestWarning")
def test_check_estimator_passes() -> None:
    check_estimator(LevenbergMarquardtRegressor(hidden=(5,), epochs=20))


def wave(rows=80, noise=0.0):
    random = np.random.default_rng(0)
    X = random.uniform(-2.0, 2.0, (rows, 1))
    return X, np.sin(2 * X[:, 0]) + noise * random.normal(size=rows)


def test_it_can_be_cross_validated() -> None:
    model = LevenbergMarquardtRegressor(hidden=(8,), epochs=60)
    assert cross_val_score(model, *wave(), cv=3).min() > 0.98


def test_rows_held_out_stop_the_training() -> None:
    model = LevenbergMarquardtRegressor(validation_share=0.25, patience=5, epochs=300)
    assert model.fit(*wave(noise=0.5)).history_.stopped == "patience"


def test_rows_with_equal_inputs_are_held_out_together() -> None:
    X, y = wave(20)
    twice = LevenbergMarquardtRegressor(hidden=(5,), validation_share=0.25, patience=5, epochs=30)
    once = LevenbergMarquardtRegressor(**twice.get_params()).fit(X, y)
    twice.fit(np.vstack([X, X]), np.concatenate([y, y]))
    assert twice.predict(X) == pytest.approx(once.predict(X), rel=1e-6)
