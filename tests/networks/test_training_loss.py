"""Losses against numpy and by hand, and settings of a training that are refused."""

from __future__ import annotations

import numpy as np
import pytest

from hil.core.errors import SpecError
from hil.estimators.parameters import settings
from hil.networks.training import Curves, Told, TrainingSettings, sparkline

torch = pytest.importorskip("torch", reason="torch is not installed")

from hil.networks.training_loop import Loss  # noqa: E402

SCALE = np.array([10.0, 2.0])


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.normal(size=(40, 2)) * SCALE, rng.normal(size=(40, 2)) * SCALE


def value(kind: str, predicted: np.ndarray, measured: np.ndarray) -> float:
    return float(Loss(kind, SCALE)(torch.tensor(predicted), torch.tensor(measured)))  # type: ignore[arg-type]


def test_smape_is_equation_20(pair: tuple[np.ndarray, np.ndarray]) -> None:
    p, m = pair
    total = sum(
        2 * abs(p[j, i] - m[j, i]) / (abs(p[j, i]) + abs(m[j, i]))
        for i in range(2)
        for j in range(len(p))
    )
    assert value("smape", p, m) == pytest.approx(total / (2 * len(p)), rel=1e-12)


def test_smape_of_nothing_from_nothing_is_0_with_a_finite_gradient() -> None:
    predicted = torch.zeros(3, 2, requires_grad=True)
    loss = Loss("smape", SCALE)(predicted, torch.zeros(3, 2))
    torch.autograd.backward(loss)
    assert float(loss.detach()) == 0.0
    assert torch.isfinite(predicted.grad).all()


def test_smape_has_no_gradient_where_the_signs_differ_and_the_floored_one_has() -> None:
    """The dead zone that makes training by eq. (20) slow."""
    slopes = {}
    for kind in ("smape", "smape-floored"):
        predicted = torch.tensor([[-5.0, 1.0]], requires_grad=True)
        torch.autograd.backward(Loss(kind, SCALE)(predicted, torch.tensor([[5.0, -1.0]])))
        slopes[kind] = predicted.grad.abs()
    assert float(slopes["smape"].max()) < 1e-7
    assert float(slopes["smape-floored"].min()) > 1e-3


def test_the_floor_is_a_tenth_of_the_standard_deviation() -> None:
    assert value("smape-floored", np.zeros((1, 2)), SCALE[None]) == pytest.approx(2 / 1.1)


def test_errors_count_in_standard_deviations(pair: tuple[np.ndarray, np.ndarray]) -> None:
    p, m = pair
    e = (p - m) / SCALE
    assert value("mse", p, m) == pytest.approx(np.mean(e**2), rel=1e-12)
    assert value("mae", p, m) == pytest.approx(np.mean(np.abs(e)), rel=1e-12)


def test_huber_turns_straight_at_a_twentieth(pair: tuple[np.ndarray, np.ndarray]) -> None:
    from scipy.special import huber

    p, m = pair
    e = (p - m) / SCALE
    # scipy's turns at delta with slope delta; torch's smooth form has slope 1 beyond it.
    assert value("huber", p, m) == pytest.approx(np.mean(huber(0.05, e)) / 0.05, rel=1e-10)


def test_an_unknown_loss_is_refused() -> None:
    with pytest.raises(SpecError, match="loss is 'rmse'"):
        Loss("rmse", SCALE)  # type: ignore[arg-type]


def test_the_papers_settings_are_its_own() -> None:
    literal = TrainingSettings.literal(epochs=7)
    assert (literal.batch_size, literal.learning_rate) == (50, 5e-4)
    assert (literal.schedule, literal.loss, literal.clip_norm) == ("constant", "smape", None)
    assert literal.epochs == 7


@pytest.mark.parametrize(
    "given",
    [
        {"epochs": 0},
        {"epoch": 5},
        {"device": "gpu"},
        {"learning_rate": float("nan")},
        {"clip_norm": float("inf")},
        {"amp": True, "precision": "float64"},
        {"group_rates": {"friction": -1}},
    ],
)
def test_settings_that_cannot_be_are_refused_by_name(given: dict[str, object]) -> None:
    with pytest.raises(SpecError, match="training"):
        settings("training", given, TrainingSettings)


def test_curves_come_back_from_json_as_they_were() -> None:
    import json

    curves = Curves(2.0)
    for epoch, stage in enumerate(("a", "a", "b"), start=1):
        curves.add(Told(stage, epoch, 3, 1 / epoch, 0.1 * epoch, 0.1, 1e-3 / 3))
    facts = json.loads(json.dumps(curves.to_dict()))
    assert Curves.from_dict(facts) == curves
    assert curves.spans() == [("a", 2), ("b", 1)]
    assert (curves.best, curves.best_epoch) == (pytest.approx(0.1), 1)


@pytest.mark.parametrize("damage", [{"loss": [1.0]}, {"stages": [["a", "x"]]}, {"loss": None}])
def test_damaged_curves_are_refused(damage: dict[str, object]) -> None:
    curves = Curves(2.0)
    curves.add(Told("a", 1, 2, 1.0, 1.0, 1.0, 1e-3))
    curves.add(Told("a", 2, 2, 1.0, 1.0, 1.0, 1e-3))
    with pytest.raises((KeyError, TypeError, ValueError)):
        Curves.from_dict(curves.to_dict() | damage)


def test_a_sparkline_falls_with_the_curve() -> None:
    assert sparkline([100.0, 10.0, 1.0]) == "█▅▁" or sparkline([100.0, 10.0, 1.0]) == "█▄▁"
    assert len(sparkline([1.0 + k for k in range(500)], width=24)) == 24
    assert sparkline([float("nan")]) == ""
