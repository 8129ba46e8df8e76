"""Scikit-learn estimator of a network trained by the Levenberg–Marquardt method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from hil.core import FloatArray
from hil.networks.lm import equal_inputs, train
from hil.networks.mlp import Mlp


class LevenbergMarquardtRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Multilayer perceptron for (X, y), trained by the Levenberg–Marquardt method.

    Args:
        hidden: Number of units of each hidden layer.
        activations: Activation of each hidden layer and of the output, each `tanh` or `linear`;
            None means tanh in all hidden layers and a linear output.
        epochs: Maximum number of epochs, with one step each.
        validation_share: Share of the rows, drawn at random, that are used for early stopping; 0
            disables early stopping. Rows with equal inputs are either all training rows or all
            validation rows.
        patience: Number of epochs without a lower validation error after which training stops.
        weight_decay: Factor of the sum of squared weights; the product is added to the mean square
            error of the standardised target.
        average: Whether rows with equal inputs are averaged, which gives the same gradient from
            fewer rows.
        precision: Number type: `float64`, or `float32` for the Jacobian and its products.
        device: Device of the training: `cpu` or `cuda`.
        random_state: Seed of the start weights and validation rows.

    Attributes:
        trained_: Trained network with its scaling.
        history_: Training history.
        n_iter_: Number of completed epochs, at least 1.

    Examples:
        >>> import numpy as np
        >>> X = np.linspace(-1.0, 1.0, 50)[:, None]
        >>> model = LevenbergMarquardtRegressor(hidden=(5,), epochs=50)
        >>> bool(model.fit(X, np.sin(3 * X[:, 0])).score(X, np.sin(3 * X[:, 0])) > 0.999)
        True
    """

    def __init__(
        self,
        *,
        hidden: Sequence[int] = (20, 20, 10),
        activations: Sequence[str] | None = None,
        epochs: int = 200,
        validation_share: float = 0.0,
        patience: int = 20,
        weight_decay: float = 0.0,
        average: bool = True,
        precision: str = "float64",
        device: str = "cpu",
        random_state: int = 0,
    ) -> None:
        self.hidden = hidden
        self.activations = activations
        self.epochs = epochs
        self.validation_share = validation_share
        self.patience = patience
        self.weight_decay = weight_decay
        self.average = average
        self.precision = precision
        self.device = device
        self.random_state = random_state

    def fit(self, X: Any, y: Any, sample_weight: Any = None) -> LevenbergMarquardtRegressor:
        """Fit to inputs X (N, d) and targets y (N,) with row weights (N,), which default to 1."""
        X, y = validate_data(self, X, y, dtype=np.float64, y_numeric=True, ensure_min_samples=2)
        weight = _weights(sample_weight, len(X))
        groups = equal_inputs(X)
        held_out = self._held_out(groups)
        labels = groups if self.average else None

        def part(rows: Any) -> tuple[Any, ...]:
            return X[rows], y[rows], weight[rows], None if labels is None else labels[rows]

        inputs, targets, weights, own = part(~held_out)
        stop: dict[str, Any] = {}
        if held_out.any():
            stop = {"validation": part(held_out), "patience": self.patience}
        self.trained_ = train(
            Mlp([X.shape[1], *self.hidden, 1], self.activations),
            inputs, targets, weights, groups=own, seed=self.random_state, epochs=self.epochs,
            weight_decay=self.weight_decay, precision=self.precision, device=self.device, **stop,
        )  # fmt: skip
        self.history_ = self.trained_.histories[0]
        self.n_iter_ = max(self.history_.epochs, 1)
        return self

    def predict(self, X: Any) -> FloatArray:
        """Return the outputs (N,)."""
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        predicted: FloatArray = self.trained_.predict(X)[:, 0]
        return predicted

    def _held_out(self, groups: Any) -> Any:
        """Return a mask (N,) of the validation rows."""
        count = int(groups.max()) + 1
        chosen = np.zeros(count, dtype=bool)
        wanted = min(round(self.validation_share * count), count - 2)
        if wanted > 0:
            random = np.random.default_rng(self.random_state)
            chosen[random.choice(count, wanted, replace=False)] = True
        return chosen[groups]


def _weights(sample_weight: Any, rows: int) -> FloatArray:
    """Return the sample weights (N,); raise ValueError if they are invalid."""
    if sample_weight is None:
        return np.ones(rows)
    weight = np.asarray(sample_weight, dtype=np.float64)
    if weight.ndim == 0:
        weight = np.full(rows, float(weight))
    if weight.shape != (rows,):
        raise ValueError(f"sample_weight has the shape {weight.shape}, not ({rows},)")
    if not np.all(np.isfinite(weight)) or np.any(weight < 0) or not np.any(weight):
        raise ValueError("sample_weight must be finite, not negative, and not zero everywhere")
    return weight
