"""Levenberg–Marquardt training of multilayer perceptrons, in batches, on the CPU or a GPU.

`train` fits B networks of one layout (`hil.networks.mlp.Mlp`) to B targets. `train` checks the
rows, averages rows with equal inputs and standardises the result. In every epoch, `Training`
linearises the networks and tries steps with increasing damping until the cost decreases. On the CPU
the training of every network is a separate task and can run in a worker process. On a GPU all
networks form one batch.

**The step.** The cost is the weighted mean square error (weights sum to 1, target of variance 1)
plus `weight_decay` times the sum of squared weights. With the Jacobian J (rows multiplied by
√weight) and the residual r, the step s solves (JᵀJ + λ·1)·s = Jᵀr − α·θ with λ = α + damping × mean
diagonal of JᵀJ (`Primal`). The dual system gives the same step as the primal system and has one
unknown per row: s = Jᵀ(J·Jᵀ + λ·1)⁻¹(r + α/λ·J·θ) − α/λ·θ. The dual system is cheaper than the
primal system if there are few rows (`Dual`).

**Averaging.** A network has equal outputs for rows with equal inputs. For a group of rows with
equal inputs and the network output f, the sum Σ (yₖ − f)² equals the group size times (mean − f)²,
plus the scatter about the mean. The scatter about the mean does not depend on the network.
Replacing a group of rows by one row, weighted by the group size, keeps the gradient, the
Gauss–Newton matrix and the minimum. The constant scatter is added back to the reported errors. A
group whose rows have different inputs is rejected with an error.

The page docs/explanation/levenberg-marquardt.md explains why the method is fast.
`hil.networks.lm_regressor` provides the same training as a scikit-learn estimator.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Protocol, TypeAlias, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from hil.core import (
    BoolArray,
    FitError,
    FloatArray,
    IntArray,
    SpecError,
    be_worker,
    process_context,
)
from hil.estimators import choice, number, require_known, whole
from hil.networks.mlp import Array, Arrays, Linearised, Mlp, Pass, Precision, arrays_on


def train(
    mlp: Mlp,
    X: FloatArray,
    Y: FloatArray,
    sample_weight: FloatArray | None = None,
    *,
    groups: Any = None,
    validation: Sequence[Any] | None = None,
    seed: int = 0,
    initial: FloatArray | None = None,
    jobs: int = 1,
    callback: Callback | None = None,
    **settings: Any,
) -> Trained:
    """Train one network per target.

    On the CPU the networks are independent tasks, so the result is bit-identical for any `jobs`. On
    a GPU all networks form one batch. On the CPU, BLAS runs with one thread, because more threads
    do not speed up matrices of this size.

    Args:
        mlp: Layout of the networks.
        X: Inputs (N, d), or (B, N, d) if every network has different inputs.
        Y: Targets (N,) or (N, B).
        sample_weight: (N,) weight of each row.
        groups: (N,) group labels. Rows with the same label have the same inputs and are averaged,
            which changes neither the gradient nor the minimum (see the module docstring).
        validation: Validation rows for early stopping: (X, Y), (X, Y, weight) or (X, Y, weight,
            groups).
        seed: Seed of the start weights; network number b draws its start weights from (seed, b).
        initial: Start weights (B, P), which replace the random start weights.
        jobs: Number of processes over which the networks are distributed.
            `hil.core.process_context` starts the processes, so a script with more than one job
            needs `if __name__ == "__main__":`.
        callback: Function that is called with the `Epoch` of every network.
        **settings: `epochs` (1000), `patience` (number of epochs without a lower validation error
            after which a network stops; None: never), `weight_decay` (0), `damping` (a `Damping`),
            `target_rmse` (training stops at this RMSE), `precision` (`float64`, or `float32` for
            the Jacobian and its products; the equations are solved in float64 in both cases),
            `device` (`cpu`, `cuda`), `solver` (`auto`, `primal`, `dual`).

    Returns:
        The trained networks. With validation rows, the returned networks have the weights of the
        lowest validation error; without validation rows they have the last weights.

    Raises:
        FitError: The data are unusable: shapes do not match, values are NaN, there are too few
            rows, or rows with one label have different inputs.
        SpecError: A setting has an invalid value, or the device is not available.
    """
    chosen = Settings.given(settings)
    rows = checked_rows(X, Y, sample_weight, groups)
    if rows.X.shape[2] != mlp.inputs:
        raise FitError(
            f"the layout {mlp} has {mlp.inputs} inputs, but the data have {rows.X.shape[2]}",
            hint="the first entry of layers is the number of inputs",
        )
    held_out = None if validation is None else checked_rows(*validation, what="validation")
    if chosen.patience is not None and held_out is None:
        raise SpecError("patience needs validation rows")
    scaling = Scaling.of(rows)
    for averaged in (rows, held_out):
        if averaged is not None:
            require_alike(averaged, scaling.input_scale)
    start = (
        np.stack([mlp.initial(seed, network) for network in range(rows.networks)])
        if initial is None
        else np.array(initial, dtype=np.float64).reshape(rows.networks, mlp.n_weights)
    )
    task = Task(mlp, rows, held_out, scaling, start, chosen)
    weights, histories = run_all(task, jobs=jobs, callback=callback)
    return Trained(mlp, weights, scaling, histories)


@dataclass(frozen=True, slots=True, eq=False)
class Trained:
    """Batch of B trained networks with one layout.

    Attributes:
        mlp: Layout of the networks.
        weights: (B, P) weights for standardised inputs and targets.
        scaling: Conversion between the units of the data and standardised values.
        histories: Training history of each network.
    """

    mlp: Mlp
    weights: FloatArray
    scaling: Scaling
    histories: tuple[History, ...] = ()

    def predict(self, X: FloatArray) -> FloatArray:
        """Return outputs (N, B) for inputs (N, d) or (B, N, d), in the unit of the targets."""
        return self.scaling.outputs(self.mlp.predict(self.weights, self.scaling.inputs(X)))


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """Training history of one network.

    Attributes:
        train_rmse: (E + 1,) training RMSE in the unit of the target; the first value is from before
            the training. Without weight decay the training RMSE never rises. With weight decay the
            cost (error plus decay term) never rises, but the training RMSE can rise.
        validation_rmse: (E + 1,) validation RMSE in the unit of the target; NaN without validation
            rows.
        damping: (E + 1,) damping after each epoch.
        best_epoch: Number of the epoch whose weights are returned.
        stopped: Reason for the end of the training: `epochs` (limit reached), `patience` (the
            validation error no longer decreases), `target` (`target_rmse` reached) or `converged`
            (no step lowers the cost).
    """

    train_rmse: FloatArray
    validation_rmse: FloatArray
    damping: FloatArray
    best_epoch: int
    stopped: str

    @staticmethod
    def of(epochs: list[Epoch], best_epoch: int, stopped: str) -> History:
        """Return the history that corresponds to the reported epochs of one network."""
        columns = np.array([(e.train_rmse, e.validation_rmse, e.damping) for e in epochs])
        return History(columns[:, 0], columns[:, 1], columns[:, 2], best_epoch, stopped)

    @property
    def epochs(self) -> int:
        """Number of completed epochs; the state before training does not count."""
        return len(self.train_rmse) - 1

    @property
    def final_train_rmse(self) -> float:
        """Training RMSE of the returned weights, in the unit of the target."""
        return float(self.train_rmse[self.best_epoch])

    @property
    def final_validation_rmse(self) -> float:
        """Validation RMSE of the returned weights; NaN without validation rows."""
        return float(self.validation_rmse[self.best_epoch])


@dataclass(frozen=True, slots=True)
class Epoch:
    """State of one network after an epoch; all errors are in the unit of the target.

    Attributes:
        network: Number of the network within the batch.
        epoch: Number of the epoch; 0 is the state before training.
        train_rmse: RMSE over all training rows, including the scatter removed by averaging.
        validation_rmse: RMSE over the validation rows; NaN without validation rows.
        damping: Damping with which the next step starts.
    """

    network: int
    epoch: int
    train_rmse: float
    validation_rmse: float
    damping: float


Callback: TypeAlias = Callable[[Epoch], object]


@dataclass(frozen=True, slots=True)
class Damping:
    """Rule that adapts the damping (relative to the mean diagonal of JᵀJ) after each step.

    Attributes:
        start: Damping before the first step.
        fall: Divisor of the damping after a step that lowers the cost.
        rise: Factor of the damping after a step that does not lower the cost.
        least, most: Minimum and maximum of the damping.
        tries: Maximum number of steps tried per epoch; if all these steps fail, the network has
            converged.
    """

    start: float = 1e-2
    fall: float = 3.0
    rise: float = 3.0
    least: float = 1e-12
    most: float = 1e12
    tries: int = 12

    def __post_init__(self) -> None:
        for name in ("start", "least", "most"):
            number(f"damping.{name}", getattr(self, name), above=0.0)
        for name in ("fall", "rise"):
            number(f"damping.{name}", getattr(self, name), above=1.0)
        whole("damping.tries", self.tries, at_least=1)


Solver = Literal["auto", "primal", "dual"]


@dataclass(frozen=True, slots=True)
class Settings:
    """Training settings, which the docstring of `train` explains."""

    epochs: int = 1000
    patience: int | None = None
    weight_decay: float = 0.0
    damping: Damping = field(default_factory=Damping)
    target_rmse: float | None = None
    precision: Precision = "float64"
    device: str = "cpu"
    solver: Solver = "auto"

    def __post_init__(self) -> None:
        whole("epochs", self.epochs, at_least=0)
        if self.patience is not None:
            whole("patience", self.patience, at_least=1)
        number("weight_decay", self.weight_decay, at_least=0.0)
        if self.target_rmse is not None:
            number("target_rmse", self.target_rmse, at_least=0.0)
        choice("precision", self.precision, get_args(Precision))
        choice("solver", self.solver, get_args(Solver))
        if not isinstance(self.device, str):
            raise SpecError(f"device is {self.device!r}, but must be cpu, cuda or cuda:1 …")

    @staticmethod
    def given(settings: dict[str, Any]) -> Settings:
        """Return training settings from keyword arguments.

        Raises:
            SpecError: A setting is unknown or has an invalid value.
        """
        require_known(settings, tuple(f.name for f in fields(Settings)), "train")
        return Settings(**settings)


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Inputs, targets and weights of training or validation rows.

    Attributes:
        X: Inputs (1, N, d), or (B, N, d) if every network has different inputs.
        Y: Targets (N, B).
        weight: (N,) weights of the rows, with sum 1.
        scatter: (B,) weighted mean square of the targets about their group means; 0 without
            averaging.
        input_scatter: (1 or B, d) weighted mean square of the inputs about their group means, which
            is almost zero for valid groups.
    """

    X: FloatArray
    Y: FloatArray
    weight: FloatArray
    scatter: FloatArray
    input_scatter: FloatArray

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def networks(self) -> int:
        """Number of targets B."""
        return int(self.Y.shape[1])

    def single(self, network: int) -> Rows:
        """Return the rows for a single network."""
        one = slice(network, network + 1)
        own = one if len(self.X) > 1 else slice(None)
        return Rows(
            self.X[own], self.Y[:, one], self.weight, self.scatter[one], self.input_scatter[own]
        )


def checked_rows(
    X: Any, Y: Any, sample_weight: Any = None, groups: Any = None, *, what: str = "training"
) -> Rows:
    """Return rows for training or validation after checking them.

    Args:
        X: Inputs (N, d) or (B, N, d).
        Y: Targets (N,) or (N, B).
        sample_weight: (N,) weight of each row; None gives every row the weight 1.
        groups: (N,) group labels; rows with the same label are averaged. With `groups` None, no
            rows are averaged.
        what: Purpose of the rows, which error messages contain.

    Raises:
        FitError: Shapes do not match, values are not finite, or there are too few rows.
    """
    X, Y = np.asarray(X, dtype=np.float64), np.asarray(Y, dtype=np.float64)
    Y = Y[:, None] if Y.ndim == 1 else Y
    X = X[None] if X.ndim == 2 else X
    _require_shapes(X, Y, what)
    _require_finite(X, "inputs", what)
    _require_finite(Y, "targets", what)
    weight = _weights(sample_weight, len(Y), what)
    scatter, of_inputs = np.zeros(Y.shape[1]), np.zeros((X.shape[0], X.shape[2]))
    if groups is not None:
        X, Y, weight, scatter, of_inputs = averaged(X, Y, weight, np.asarray(groups))
    if len(Y) < 2:
        raise FitError(
            f"{len(Y)} {what} row(s) are not enough to train a network",
            hint="pass at least two different rows",
        )
    return Rows(X, Y, weight, scatter, of_inputs)


def _require_shapes(X: FloatArray, Y: FloatArray, what: str) -> None:
    if X.ndim != 3 or Y.ndim != 2 or X.shape[1] != len(Y) or X.shape[0] not in (1, Y.shape[1]):
        raise FitError(
            f"the {what} inputs {X.shape} and targets {Y.shape} have incompatible shapes",
            hint="inputs are (N, d) or (B, N, d), targets (N,) or (N, B)",
        )


def _require_finite(values: FloatArray, name: str, what: str) -> None:
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise FitError(
            f"{bad} of the {what} {name} are NaN or infinite",
            hint="remove these rows, or correct them at their source",
        )


def _weights(sample_weight: Any, rows: int, what: str) -> FloatArray:
    if sample_weight is None:
        return np.full(rows, 1.0 / max(rows, 1))
    weight = np.asarray(sample_weight, dtype=np.float64)
    if weight.shape != (rows,):
        raise FitError(f"{what} sample_weight has the shape {weight.shape}, not ({rows},)")
    if not np.all(np.isfinite(weight)) or np.any(weight < 0) or not np.any(weight):
        raise FitError(
            f"{what} sample_weight must be finite, not negative, and not zero everywhere"
        )
    return np.asarray(weight / weight.sum())


def averaged(
    X: FloatArray, Y: FloatArray, weight: FloatArray, groups: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Average the rows of each group.

    The groups are sorted by label. Groups with weight 0 are omitted from the result.

    Args:
        X: Inputs (B, N, d).
        Y: Targets (N, B).
        weight: (N,) weights of the rows.
        groups: (N,) group labels.

    Returns:
        Means of X and Y per group, total weight of each group, and the weighted mean squares about
        the group means of Y (B,) and of X (B, d).

    Raises:
        FitError: The number of labels differs from the number of rows.
    """
    if groups.shape != weight.shape:
        raise FitError(f"groups has the shape {groups.shape}, but there are {len(weight)} rows")
    groups, weight_used = groups[weight > 0], weight[weight > 0]
    X, Y = X[:, weight > 0], Y[weight > 0]
    order = np.argsort(groups, kind="stable")
    labels = groups[order]
    starts = np.flatnonzero(np.concatenate(([True], labels[1:] != labels[:-1])))
    total = np.add.reduceat(weight_used[order], starts)
    count = np.diff(np.append(starts, len(labels)))
    share = weight_used[order] / np.repeat(total, count)
    X_mean = np.add.reduceat(X[:, order] * share[:, None], starts, axis=1)
    Y_mean = np.add.reduceat(Y[order] * share[:, None], starts, axis=0)
    astray = Y[order] - np.repeat(Y_mean, count, axis=0)
    X_astray = X[:, order] - np.repeat(X_mean, count, axis=1)
    of_inputs = np.einsum("n,bnd->bd", weight_used[order], X_astray**2)
    return X_mean, Y_mean, total, weight_used[order] @ astray**2, of_inputs


MOST_SPREAD = 0.05
"""Largest permitted variation of an input within a group, as a share of its standard deviation.

The permitted share allows for noise or one resolution step of a thermometer. A variation of this
size changes the output by at most about the same share of the output's standard deviation, and the
RMSE by the square of that share.
"""


def require_alike(rows: Rows, input_scale: FloatArray) -> None:
    """Raise if rows of one group have different inputs, so that one row cannot replace them.

    Args:
        rows: Training or validation rows, grouped.
        input_scale: (1 or B, d) standard deviation of the training inputs between groups.
            Validation rows are also compared with the standard deviation of the training inputs,
            because validation rows of a single pose vary only by noise.

    Raises:
        FitError: An input varies within groups by more than `MOST_SPREAD`.
    """
    within = np.sqrt(rows.input_scatter)
    share = np.max(within / np.hypot(input_scale, within), axis=0)
    if np.any(share > MOST_SPREAD):
        worst = int(np.argmax(share))
        raise FitError(
            f"input {worst + 1} of {len(share)} is not constant within the groups to be "
            f"averaged: {share[worst]:.0%} of its total variation is inside groups",
            hint="disable averaging (averaging: false, or no groups), or use an input that is "
            "constant within each group",
        )


def equal_inputs(X: FloatArray) -> IntArray:
    """Return labels (N,) for rows of (N, d) or (B, N, d); equal input rows get equal labels."""
    flat = X if X.ndim == 2 else np.concatenate(list(X), axis=1)
    _, label = np.unique(flat, axis=0, return_inverse=True)
    return np.asarray(label, dtype=np.int64).reshape(-1)


class ConstantInputWarning(UserWarning):
    """Warning about an input that is constant in all rows, from which no network can learn."""


CONSTANT = 1e-12
"""Maximum standard deviation of a constant column, as a share of the column's absolute mean."""


@dataclass(frozen=True, slots=True, eq=False)
class Scaling:
    """Mean and standard deviation of inputs and targets.

    Attributes:
        input_mean, input_scale: (1 or B, d) mean and standard deviation of the inputs.
        target_mean, target_scale: (B,) mean and standard deviation of the targets.
    """

    input_mean: FloatArray
    input_scale: FloatArray
    target_mean: FloatArray
    target_scale: FloatArray

    @staticmethod
    def of(rows: Rows) -> Scaling:
        """Return the scaling of weighted rows; warn about constant columns, which are only centred.

        The target scale includes the scatter that averaging removed, so averaged rows are scaled
        like the original rows.

        Raises:
            FitError: Values are so large that their squares overflow.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            x_mean = np.einsum("n,bnd->bd", rows.weight, rows.X)
            x_square = np.einsum("n,bnd->bd", rows.weight, (rows.X - x_mean[:, None]) ** 2)
            y_mean = rows.weight @ rows.Y
            y_square = rows.weight @ (rows.Y - y_mean) ** 2 + rows.scatter
        if not np.all(np.isfinite(x_square)) or not np.all(np.isfinite(y_square)):
            raise FitError("inputs or targets are too large to be squared; check their units")
        x_scale = _deviation(x_square, x_mean)
        constant = np.flatnonzero(np.all(x_scale == 0, axis=0))
        if len(constant):
            listed = ", ".join(str(k + 1) for k in constant)
            warnings.warn(
                f"input {listed} of {rows.X.shape[2]} has the same value in every row: the "
                "network cannot learn its effect, and predictions at other values are meaningless",
                ConstantInputWarning,
                stacklevel=4,
            )
        y_scale = _deviation(y_square, y_mean)
        x_scale, y_scale = (np.where(scale > 0, scale, 1.0) for scale in (x_scale, y_scale))
        return Scaling(x_mean, x_scale, y_mean, y_scale)

    def single(self, network: int) -> Scaling:
        """Return the scaling for a single network."""
        one = slice(network, network + 1)
        inputs = one if len(self.input_mean) > 1 else slice(None)
        return Scaling(
            self.input_mean[inputs],
            self.input_scale[inputs],
            self.target_mean[one],
            self.target_scale[one],
        )

    def inputs(self, X: FloatArray) -> FloatArray:
        """Return standardised inputs (1 or B, N, d) for inputs (N, d) or (B, N, d)."""
        batch = X[None] if X.ndim == 2 else X
        return (batch - self.input_mean[:, None]) / self.input_scale[:, None]

    def targets(self, Y: FloatArray) -> FloatArray:
        """Return standardised targets (B, N) for targets (N, B)."""
        return ((Y - self.target_mean) / self.target_scale).T

    def outputs(self, standard: FloatArray) -> FloatArray:
        """Return outputs (N, B) in the unit of the target for standardised outputs (B, N)."""
        return standard.T * self.target_scale + self.target_mean


def _deviation(square: FloatArray, mean: FloatArray) -> FloatArray:
    found = np.sqrt(square)
    found[found <= CONSTANT * np.abs(mean)] = 0.0
    return found


LEAST_GAIN = 1e-6
"""Relative decrease that a lower validation error must exceed to count as an improvement.

The threshold excludes decreases that are only caused by rounding.
"""


class Training:
    """Training of the networks of one batch, in which each network stops independently."""

    def __init__(self, task: Task) -> None:
        mlp, rows, settings, scaling = task.mlp, task.rows, task.settings, task.scaling
        self._mlp, self._settings, self._scaling, self._first = mlp, settings, scaling, task.first
        self._arrays: Arrays = arrays_on(settings.device, settings.precision)
        self._rows, self._held_out = rows, task.validation
        self._X = self._arrays.inputs(scaling.inputs(rows.X))
        self._Y = self._arrays.asarray(scaling.targets(rows.Y))
        self._root = self._arrays.asarray(np.sqrt(rows.weight))
        if task.validation is not None:
            self._X_held_out = self._arrays.inputs(scaling.inputs(task.validation.X))
        self._dual = settings.solver == "dual" or (
            settings.solver == "auto" and dual_is_faster(mlp, len(rows))
        )
        self._weights = np.array(task.start)
        self._best = np.array(task.start)
        self._damping = np.full(len(task.start), float(settings.damping.start))
        self._passed = self._forward(self._weights)
        self._cost = self._cost_of(self._weights, self._passed)
        if not np.all(np.isfinite(self._cost)):
            raise FitError("the cost of the initial weights is not finite", hint="scale the data")
        self._epochs: list[list[Epoch]] = [[] for _ in task.start]
        self._best_epoch = np.zeros(len(task.start), dtype=int)
        self._stopped = [""] * len(task.start)

    def run(self, callback: Callback | None = None) -> Result:
        """Train until all networks have stopped; return weights (B, P) and histories."""
        self._note(0, callback)
        for epoch in range(1, self._settings.epochs + 1):
            if not self._active().any():
                break
            self._advance()
            self._note(epoch, callback)
        histories = tuple(
            History.of(noted, int(best), stopped or "epochs")
            for noted, best, stopped in zip(
                self._epochs, self._best_epoch, self._stopped, strict=True
            )
        )
        return self._best, histories

    def _active(self) -> BoolArray:
        return np.array([not stopped for stopped in self._stopped])

    def _forward(self, weights: FloatArray) -> Pass:
        return self._mlp.forward(self._arrays.asarray(weights), self._X, self._arrays)

    def _cost_of(self, weights: FloatArray, passed: Pass) -> FloatArray:
        """Return the cost (B,): mean square error plus weight decay."""
        astray = self._arrays.to_numpy((self._Y - passed.output) * self._root)
        return np.asarray(
            np.sum(astray**2, axis=1) + self._settings.weight_decay * np.sum(weights**2, axis=1)
        )

    def _system(self) -> System:
        at = self._passed.linearised(self._root)
        residual = (self._Y - self._passed.output) * self._root
        weights = self._arrays.asarray(self._weights)
        decay = self._settings.weight_decay
        if self._dual:
            return Dual(at, residual, weights, decay, self._arrays, self._mlp)
        return Primal(at, residual, weights, decay, self._arrays)

    def _advance(self) -> None:
        """Take one step in each active network with the lowest damping that reduces its cost."""
        rule, pending, system = self._settings.damping, self._active(), self._system()
        for _ in range(rule.tries):
            step, computed = system.step(self._damping)
            trial = self._weights + self._arrays.to_numpy(step)
            passed = self._forward(trial)
            with np.errstate(invalid="ignore", over="ignore"):
                cost = self._cost_of(trial, passed)
            better = pending & computed & (cost < self._cost)
            self._weights[better], self._cost[better] = trial[better], cost[better]
            self._damping[better] = np.maximum(self._damping[better] / rule.fall, rule.least)
            pending &= ~better
            if not pending.any():
                break
            self._damping[pending] = np.minimum(self._damping[pending] * rule.rise, rule.most)
        for network in np.flatnonzero(pending):
            self._stopped[network] = "converged"
        self._passed = passed if better.all() else self._forward(self._weights)

    def _note(self, number: int, callback: Callback | None) -> None:
        """Record the state of each network, store the best weights and stop finished networks."""
        square = self._cost - self._settings.weight_decay * np.sum(self._weights**2, axis=1)
        unit = self._scaling.target_scale
        train = np.sqrt(np.maximum(square, 0.0) * unit**2 + self._rows.scatter)
        held_out = self._validation_rmse()
        for network, noted in enumerate(self._epochs):
            if self._stopped[network]:
                continue
            errors = float(train[network]), float(held_out[network])
            epoch = Epoch(self._first + network, number, *errors, float(self._damping[network]))
            noted.append(epoch)
            self._judge(network, epoch)
            if callback is not None:
                callback(epoch)

    def _judge(self, network: int, epoch: Epoch) -> None:
        settings = self._settings
        best = self._epochs[network][self._best_epoch[network]]
        enough = best.validation_rmse * (1.0 - LEAST_GAIN)
        # At epoch 0 the best epoch is 0 as well, so `_best` already contains these weights.
        if self._held_out is None or epoch.validation_rmse < enough:
            self._best_epoch[network] = epoch.epoch
            self._best[network] = self._weights[network]
        if settings.target_rmse is not None and epoch.train_rmse <= settings.target_rmse:
            self._stopped[network] = "target"
        waited = epoch.epoch - self._best_epoch[network]
        if settings.patience is not None and waited >= settings.patience:
            self._stopped[network] = "patience"

    def _validation_rmse(self) -> FloatArray:
        if self._held_out is None:
            return np.full(len(self._weights), np.nan)
        passed = self._mlp.forward(
            self._arrays.asarray(self._weights), self._X_held_out, self._arrays
        )
        found = self._scaling.outputs(self._arrays.to_numpy(passed.output))
        square = self._held_out.weight @ (found - self._held_out.Y) ** 2
        return np.asarray(np.sqrt(square + self._held_out.scatter))


class System(Protocol):
    """Interface of a linearised problem that can be solved for several damping values."""

    def step(self, damping: FloatArray) -> tuple[Array, BoolArray]:
        """Return steps (B, P) for damping values (B,), and a mask (B,) of the computable steps."""


class Primal:
    """Linear system with one unknown per weight: (JᵀJ + λ·1)·s = g."""

    def __init__(
        self, at: Linearised, residual: Array, weights: Array, decay: float, arrays: Arrays
    ) -> None:
        self._matrix = at.normal_matrix()
        self._target = at.transposed_times(residual) - decay * weights
        self._size = arrays.mean_diagonal(self._matrix)
        self._decay, self._arrays = decay, arrays

    def step(self, damping: FloatArray) -> tuple[Array, BoolArray]:
        """Return steps (B, P) for damping values (B,), and a mask (B,) of the computable steps."""
        shift = self._decay + damping * self._size
        return self._arrays.solve(self._matrix, shift, self._target)


class Dual:
    """Dual linear system of the step, with one unknown per row."""

    def __init__(
        self, at: Linearised, residual: Array, weights: Array, decay: float, arrays: Arrays,
        mlp: Mlp,
    ) -> None:  # fmt: skip
        self._at, self._residual, self._weights = at, residual, weights
        self._matrix = at.kernel()
        self._size = arrays.mean_diagonal(self._matrix) * at.rows / at.weights
        self._decay, self._arrays = decay, arrays
        self._along = at.times(mlp.matrices(weights)) if decay else None

    def step(self, damping: FloatArray) -> tuple[Array, BoolArray]:
        """Return steps (B, P) for damping values (B,), and a mask (B,) of the computable steps."""
        shift = self._decay + damping * self._size
        target = self._residual
        share = self._arrays.asarray(self._decay / np.maximum(shift, np.finfo(float).tiny))[:, None]
        if self._along is not None:
            target = target + share * self._along
        dual, definite = self._arrays.solve(self._matrix, shift, target)
        step = self._at.transposed_times(dual)
        return step - share * self._weights if self._along is not None else step, definite


def dual_is_faster(mlp: Mlp, rows: int) -> bool:
    """Return whether building and factoring the dual system needs fewer multiplications."""
    factors = sum(inputs + units for inputs, units in mlp.shapes)
    # The small block products of the kernel run at about a third of the speed of one large product.
    dual = 3 * rows**2 * factors + rows**3 / 3
    primal = rows * mlp.n_weights**2 + mlp.n_weights**3 / 3
    return dual < primal


Result = tuple[FloatArray, tuple[History, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Networks that are trained together; `first` is the number of the first one in the batch."""

    mlp: Mlp
    rows: Rows
    validation: Rows | None
    scaling: Scaling
    start: FloatArray
    settings: Settings
    first: int = 0

    def single(self, network: int) -> Task:
        """Return the task for a single network."""
        return Task(
            self.mlp,
            self.rows.single(network),
            self.validation and self.validation.single(network),
            self.scaling.single(network),
            self.start[network : network + 1],
            self.settings,
            network,
        )

    def run(self, callback: Callback | None = None) -> Result:
        """Train the networks of the task with one BLAS thread."""
        with threadpool_limits(1):
            return Training(self).run(callback)


def run_all(task: Task, *, jobs: int, callback: Callback | None) -> Result:
    """Train all networks of a task, in worker processes if `jobs` is greater than 1.

    Raises:
        SpecError: `jobs` is not a positive whole number.
    """
    whole("jobs", jobs, at_least=1)
    if task.settings.device != "cpu":
        return task.run(callback)
    alone = [task.single(network) for network in range(task.rows.networks)]
    if jobs == 1 or len(alone) == 1:
        return _joined([one.run(callback) for one in alone])
    return _joined(_spread(alone, min(jobs, len(alone)), callback))


def _joined(results: list[Result]) -> Result:
    weights = np.concatenate([weights for weights, _ in results])
    return weights, tuple(history for _, histories in results for history in histories)


def _spread(tasks: list[Task], jobs: int, callback: Callback | None) -> list[Result]:
    context = process_context()
    reports, ended = context.SimpleQueue(), context.Event()
    begin = (reports, ended, callback is not None)
    with ProcessPoolExecutor(jobs, context, _begin_worker, begin) as pool:
        futures = [pool.submit(_run_in_worker, task) for task in tasks]
        try:
            _follow(futures, reports, callback)
        except BaseException:
            # Read the queue until all workers have ended; a worker blocks while the pipe is full.
            ended.set()
            for future in futures:
                future.cancel()
            _follow(futures, reports, None)
            raise
    return [future.result() for future in futures]


POLL_S = 0.05
"""Time [s] between two transfers of epochs from worker processes to the callback."""


def _follow(futures: list[Future[Result]], reports: Any, callback: Callback | None) -> None:
    pending = set(futures)
    while pending:
        _, pending = wait(pending, timeout=POLL_S)
        while not reports.empty():
            epoch = reports.get()
            if callback is not None:
                callback(epoch)


class _Ended(Exception):
    """Exception that ends a worker process whose result is no longer needed."""


_report: Callable[[Epoch], None] | None = None
"""Function that sends an epoch to the parent process; set only in worker processes."""


def _begin_worker(reports: Any, ended: Any, wanted: bool) -> None:
    be_worker()

    def report(epoch: Epoch) -> None:
        if ended.is_set():
            raise _Ended
        if wanted:
            reports.put(epoch)

    global _report
    _report = report


def _run_in_worker(task: Task) -> Result:
    return task.run(_report)
