"""A residual network as a problem for the training loop: what it learns, and from what not."""

from dataclasses import replace

import numpy as np
import pytest

from hil.core.errors import DataError
from hil.networks.residual_data import Motions
from tests.support.residual_parts import OFFSETS, ROWS, motions, problem, small

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.residual_training import ResidualProblem  # noqa: E402
from hil.networks.training import TrainingSettings, joint_stages  # noqa: E402
from hil.networks.training_loop import train  # noqa: E402


def stepped(made, steps: int = 5, rate: float = 3e-3) -> None:
    """A few steps with all crops."""
    adam = torch.optim.Adam(made.module.parameters(), lr=rate)
    for _ in range(steps):
        adam.zero_grad()
        made.loss(torch.arange(made.samples)).backward()
        adam.step()


@pytest.mark.parametrize("split", [True, False])
@pytest.mark.parametrize("layout", ["grouped", "joint"])
def test_validation_is_the_error_of_predictions_in_the_rows_to_stop_by(layout, split) -> None:
    made = problem(small(layout=layout, split=split, every=1))
    stepped(made)
    error = (made.motions.effort - made.motions.base) - made.trained().predict(made.motions)
    expected = np.sqrt(np.mean(error[ROWS // 2 :] ** 2, axis=0))
    assert made.validation_errors() == pytest.approx(expected, rel=1e-4)


def test_the_loss_is_the_mean_square_of_errors_over_the_residuals_size() -> None:
    made = problem(small(split=False, every=1))
    stepped(made)
    residual = (made.motions.effort - made.motions.base)[: ROWS // 2]
    error = residual - made.trained().predict(made.motions)[: ROWS // 2]
    expected = np.mean(error**2 / np.mean(residual**2, axis=0))
    assert made.loss(torch.arange(made.samples)).item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("layout", ["grouped", "joint"])
def test_rows_to_stop_by_do_not_teach(layout) -> None:
    recorded = motions()
    other = {name: getattr(recorded, name).copy() for name in ("q", "qd", "qdd", "base", "effort")}
    for values in other.values():
        values[OFFSETS[2] :] = values[OFFSETS[2] :] * 3.0 + 1.0
        values[OFFSETS[2] :: 2] *= -1.0
    learn = np.arange(ROWS) < OFFSETS[1]
    taught = [
        _taught(
            found,
            learn,
            np.arange(ROWS) >= OFFSETS[2],
            small(layout=layout, split=True, inputs="history"),
        )
        for found in (recorded, replace(recorded, **other))
    ]
    assert all(np.array_equal(taught[0][name], taught[1][name]) for name in taught[0])


@pytest.mark.parametrize("torn", [True, False])
def test_torque_of_rows_that_are_not_learned_from_does_not_teach(torn) -> None:
    """Within one series: rows drawn one by one, or its end."""
    recorded = motions(offsets=np.array([0, ROWS]))
    learn = np.random.default_rng(2).random(ROWS) < 0.6 if torn else np.arange(ROWS) < 400
    effort = np.where(learn[:, None], recorded.effort, 3.0 * recorded.effort + 1.0)
    taught = [
        _taught(found, learn, ~learn, small(layout="joint"))
        for found in (recorded, replace(recorded, effort=effort))
    ]
    assert all(np.array_equal(taught[0][name], taught[1][name]) for name in taught[0])


def _taught(found, learn, validate, settings):
    made = ResidualProblem(found, found.effort - found.base, learn, validate, settings)
    stepped(made)
    return made.trained().to_arrays()


def _with_rows(found, learn, validate):
    settings = small(inputs="history", f_cut_hz=5.0)
    return ResidualProblem(found, found.effort - found.base, learn, validate, settings)


def test_equal_seeds_give_equal_networks_and_other_seeds_others() -> None:
    found = []
    for seed in (3, 3, 4):
        made = problem(small(), seed=seed)
        stepped(made)
        found.append(made.trained().predict(made.motions))
    assert np.array_equal(found[0], found[1])
    assert not np.allclose(found[0], found[2])


@pytest.mark.parametrize("name", ["q", "base", "effort"])
def test_values_that_are_not_finite_are_told(name) -> None:
    recorded = motions()
    residual = recorded.effort - recorded.base
    getattr(recorded, name)[3, 1] = np.nan
    learn = np.arange(ROWS) < OFFSETS[1]
    with pytest.raises(DataError, match=f"{name} of the residual network is not finite"):
        ResidualProblem(recorded, residual, learn, ~learn, small())


def test_rows_to_stop_by_are_needed() -> None:
    with pytest.raises(DataError, match="rows to stop by"):
        _with_rows(motions(), np.ones(ROWS, dtype=bool), np.zeros(ROWS, dtype=bool))


def test_a_joint_that_never_moves_and_has_no_residual_is_learned_as_nothing() -> None:
    recorded = motions()
    for name in ("q", "qd", "qdd", "base", "effort"):
        getattr(recorded, name)[:, 0] = 0.0
    made = problem(small(f_cut_hz=5.0), recorded)
    stepped(made)
    out = made.trained().predict(recorded)
    assert np.all(np.isfinite(out))
    assert np.abs(out[:, 0]).max() < 0.05 * np.abs(out[:, 1]).max()


@pytest.mark.thorough
def test_friction_that_lags_behind_reversals_is_learned_from_motion_alone() -> None:
    """A residual with memory: a first-order lag of sign(q̇), unseen by any memoryless model."""
    recorded, residual = _lagging()
    learn = np.arange(len(recorded)) < len(recorded) // 2
    made = ResidualProblem(recorded, residual, learn, ~learn, small(dilations=(1, 4, 16), every=4))
    before = made.validate()
    settings = TrainingSettings(epochs=30, batch_size=8, learning_rate=1e-2, device="cpu")
    train(made, joint_stages(settings), settings)
    assert made.validate() < 0.35 * before


def _lagging() -> tuple[Motions, np.ndarray]:
    random = np.random.default_rng(0)
    t = np.arange(6000) / 500.0
    phases = random.uniform(0, 6, size=(3, 1))
    qd = np.sin(np.array([[1.7], [4.1], [7.3]]) * t + phases).sum(axis=0)[:, None]
    lagged = np.zeros_like(qd)
    for k in range(1, len(qd)):
        lagged[k] = lagged[k - 1] + (np.sign(qd[k]) - lagged[k - 1]) / 12.0
    friction = lagged - np.sign(qd)
    qdd = np.gradient(qd, 1 / 500.0, axis=0)
    return Motions(qd, qd, qdd, qd, None, np.array([0, 3000, 6000]), 500.0), friction
