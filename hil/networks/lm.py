"""Levenberg–Marquardt for multilayer perceptrons: our own, batched, on the CPU or a GPU.

`train` fits B networks of one layout (`hil.networks.mlp.Mlp`) to B targets. The rows are checked,
averaged where their inputs are the same, and standardised; then every epoch (`Training`) linearises
the networks and tries steps with more and more damping until the cost falls. On the CPU every
network is a task of its own, which may run in a worker process; on a GPU all are one batch.

**The step.** The cost is the weighted mean square error (weights sum to 1, target of variance 1)
plus `weight_decay` times the sum of squared weights. With J the Jacobian, rows times √weight, and r
the residual, the step solves (JᵀJ + λ·1)·s = Jᵀr − α·θ, λ = α + damping × mean diagonal of JᵀJ
(`Primal`). The same step follows from the dual system of as many unknowns as rows,
s = Jᵀ(J·Jᵀ + λ·1)⁻¹(r + α/λ·J·θ) − α/λ·θ, which is less work when rows are few (`Dual`).

**Averaging.** Rows with equal inputs have equal outputs, so Σ (yₖ − f)² over such a group is its
size times (mean − f)² plus the scatter about the mean, in which the network does not occur. One row
per group, weighted by its size, therefore has the same gradient, Gauss–Newton matrix and minimum as
all of them; the constant is added again to the reported errors. Inputs that differ within a group
are refused.

docs/explanation/levenberg-marquardt.md explains why it is fast; `hil.networks.lm_regressor` offers
the same with scikit-learn's contract.
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

    On the CPU the networks are independent tasks, so results do not depend on `jobs`, bit for bit;
    on a GPU all are one batch. BLAS gets one thread: more only spin on matrices of this size.

    Args:
        mlp: Layout of the networks.
        X: Inputs (N, d), or (B, N, d) when every network has its own.
        Y: Targets (N,) or (N, B).
        sample_weight: (N,) importance of each row.
        groups: (N,) labels; rows of one label have the same inputs and are averaged, which
            changes neither gradient nor minimum (see the module).
        validation: (X, Y), (X, Y, weight) or (X, Y, weight, groups): rows to stop by.
        seed: For the start weights; network b draws its own from (seed, b).
        initial: Start weights (B, P) instead.
        jobs: Processes to spread the networks over. They are started by `hil.core.process_context`,
            so a script that asks for more than one needs `if __name__ == "__main__":`.
        callback: Called with the `Epoch` of every network.
        **settings: `epochs` (1000), `patience` (epochs without a better validation error until a
            network stops; None: never), `weight_decay` (0), `damping` (`Damping`), `target_rmse`
            (stop there), `precision` (`float64`; `float32` for the Jacobian and its products, the
            solution stays in float64), `device` (`cpu`, `cuda`), `solver` (`auto`, `primal`,
            `dual`).

    Returns:
        The networks, with the weights of the best validation error, or the last.

    Raises:
        FitError: The data do not allow it: shapes, NaN, too few rows, rows of one label whose
            inputs differ.
        SpecError: A setting cannot be, or the device is not there.
    """
    chosen = Settings.given(settings)
    rows = checked_rows(X, Y, sample_weight, groups)
    if rows.X.shape[2] != mlp.inputs:
        raise FitError(
            f"the layout {mlp} has {mlp.inputs} inputs, the data {rows.X.shape[2]}",
            hint="the first of the layers is the number of inputs",
        )
    held_out = None if validation is None else checked_rows(*validation, what="validation")
    if chosen.patience is not None and held_out is None:
        raise SpecError("patience needs validation rows to judge by")
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
    """B trained networks of one layout.

    Attributes:
        mlp: Their layout.
        weights: (B, P), for standardised inputs and targets.
        scaling: From and to the units of the data.
        histories: How each was trained.
    """

    mlp: Mlp
    weights: FloatArray
    scaling: Scaling
    histories: tuple[History, ...] = ()

    def predict(self, X: FloatArray) -> FloatArray:
        """(N, B) outputs for inputs (N, d) or (B, N, d), in the unit of the targets."""
        return self.scaling.outputs(self.mlp.predict(self.weights, self.scaling.inputs(X)))


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """How the training of one network went.

    Attributes:
        train_rmse: (E + 1,) in the unit of the target, the start first. Never rises without weight
            decay; with it the sum of both does not, and this may.
        validation_rmse: (E + 1,), NaN without validation rows.
        damping: (E + 1,).
        best_epoch: Whose weights were kept.
        stopped: Why it ended: `epochs`, `patience` (the validation error fell no more),
            `target` (`target_rmse` reached), or `converged` (no step lowers the cost any more).
    """

    train_rmse: FloatArray
    validation_rmse: FloatArray
    damping: FloatArray
    best_epoch: int
    stopped: str

    @staticmethod
    def of(epochs: list[Epoch], best_epoch: int, stopped: str) -> History:
        """From the epochs of one network."""
        columns = np.array([(e.train_rmse, e.validation_rmse, e.damping) for e in epochs])
        return History(columns[:, 0], columns[:, 1], columns[:, 2], best_epoch, stopped)

    @property
    def epochs(self) -> int:
        """Epochs done, the start not counted."""
        return len(self.train_rmse) - 1

    @property
    def final_train_rmse(self) -> float:
        """Of the weights that were kept."""
        return float(self.train_rmse[self.best_epoch])

    @property
    def final_validation_rmse(self) -> float:
        """Of the weights that were kept; NaN without validation rows."""
        return float(self.validation_rmse[self.best_epoch])


@dataclass(frozen=True, slots=True)
class Epoch:
    """Where one network is after an epoch; errors in the unit of the target.

    Attributes:
        network: Number within the batch.
        epoch: 0 is the start.
        train_rmse: On all training rows, averaged or not.
        validation_rmse: NaN without validation rows.
        damping: That the next step starts with.
    """

    network: int
    epoch: int
    train_rmse: float
    validation_rmse: float
    damping: float


Callback: TypeAlias = Callable[[Epoch], object]


@dataclass(frozen=True, slots=True)
class Damping:
    """How the damping, relative to the mean diagonal of JᵀJ, follows success and failure.

    Attributes:
        start: Before the first step.
        fall: It is divided by this after a step that lowers the cost.
        rise: It is multiplied by this after one that does not.
        least, most: Its limits.
        tries: Steps tried per epoch; when all fail, that network has converged.
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
    """How to train; `train` explains each."""

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
        """From keyword arguments.

        Raises:
            SpecError: There is no such setting, or it cannot have that value.
        """
        require_known(settings, tuple(f.name for f in fields(Settings)), "train")
        return Settings(**settings)


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Inputs, targets and weights.

    Attributes:
        X: (1, N, d), or (B, N, d) when every network has its own inputs.
        Y: (N, B).
        weight: (N,), sums to 1.
        scatter: (B,) weighted mean square of what averaging took away; 0 without.
        input_scatter: (1 or B, d) the same of the inputs, which should be next to nothing.
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
        """What one of the networks sees."""
        one = slice(network, network + 1)
        own = one if len(self.X) > 1 else slice(None)
        return Rows(
            self.X[own], self.Y[:, one], self.weight, self.scatter[one], self.input_scatter[own]
        )


def checked_rows(
    X: Any, Y: Any, sample_weight: Any = None, groups: Any = None, *, what: str = "training"
) -> Rows:
    """Rows for training or validation.

    Args:
        X: (N, d), or (B, N, d).
        Y: (N,) or (N, B).
        sample_weight: (N,), all 1 when None.
        groups: (N,) labels; rows of the same label are averaged. None averages nothing.
        what: The rows' purpose, for messages.

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
            f"{len(Y)} {what} row(s) are too few for a network",
            hint="give at least two rows that differ",
        )
    return Rows(X, Y, weight, scatter, of_inputs)


def _require_shapes(X: FloatArray, Y: FloatArray, what: str) -> None:
    if X.ndim != 3 or Y.ndim != 2 or X.shape[1] != len(Y) or X.shape[0] not in (1, Y.shape[1]):
        raise FitError(
            f"the {what} inputs {X.shape} and targets {Y.shape} do not go together",
            hint="inputs are (N, d) or (B, N, d), targets (N,) or (N, B)",
        )


def _require_finite(values: FloatArray, name: str, what: str) -> None:
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise FitError(
            f"{bad} of the {what} {name} are NaN or infinite",
            hint="leave those rows out, or find out why they were recorded so",
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
    """One row per group: means of X (B, N, d) and Y (N, B), total weight, scatter (B,) and (B, d).

    Groups keep the order of their labels. Groups of weight 0 vanish.

    Raises:
        FitError: There is not one label per row.
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
"""Within groups an input may vary by this share of its deviation: noise, a step of a thermometer.
That moves the output by as large a share of its own at most, and the RMSE by the square of it."""


def require_alike(rows: Rows, input_scale: FloatArray) -> None:
    """Refuse groups whose inputs differ: one row cannot stand for theirs, nor can its error.

    Args:
        rows: For training or validation.
        input_scale: (1 or B, d) standard deviation of the training inputs between groups. It judges
            validation rows as well: those may be of one pose, where noise is all there is.

    Raises:
        FitError: An input varies within groups.
    """
    within = np.sqrt(rows.input_scatter)
    share = np.max(within / np.hypot(input_scale, within), axis=0)
    if np.any(share > MOST_SPREAD):
        worst = int(np.argmax(share))
        raise FitError(
            f"input {worst + 1} of {len(share)} varies within the groups that are to be averaged, "
            f"by {share[worst]:.0%} of all its variation, so their rows are not alike",
            hint="do not average (averaging: false, or no groups), or use an input that is the "
            "same in all rows of a group",
        )


def equal_inputs(X: FloatArray) -> IntArray:
    """(N,) label of each row of (N, d) or (B, N, d): the same for rows whose inputs are equal."""
    flat = X if X.ndim == 2 else np.concatenate(list(X), axis=1)
    _, label = np.unique(flat, axis=0, return_inverse=True)
    return np.asarray(label, dtype=np.int64).reshape(-1)


class ConstantInputWarning(UserWarning):
    """An input has the same value in every row, so the network cannot learn from it."""


CONSTANT = 1e-12
"""A column whose deviation is below this share of its size does not vary."""


@dataclass(frozen=True, slots=True, eq=False)
class Scaling:
    """Mean and deviation of inputs and targets.

    Attributes:
        input_mean, input_scale: (1 or B, d).
        target_mean, target_scale: (B,).
    """

    input_mean: FloatArray
    input_scale: FloatArray
    target_mean: FloatArray
    target_scale: FloatArray

    @staticmethod
    def of(rows: Rows) -> Scaling:
        """From the weighted rows; constant columns are warned of and only centred.

        What averaging took away counts too, so that averaged rows are scaled as all of them.

        Raises:
            FitError: Values are so large that their squares overflow.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            x_mean = np.einsum("n,bnd->bd", rows.weight, rows.X)
            x_square = np.einsum("n,bnd->bd", rows.weight, (rows.X - x_mean[:, None]) ** 2)
            y_mean = rows.weight @ rows.Y
            y_square = rows.weight @ (rows.Y - y_mean) ** 2 + rows.scatter
        if not np.all(np.isfinite(x_square)) or not np.all(np.isfinite(y_square)):
            raise FitError("inputs or targets are too large to be squared: are the units right?")
        x_scale = _deviation(x_square, x_mean)
        constant = np.flatnonzero(np.all(x_scale == 0, axis=0))
        if len(constant):
            listed = ", ".join(str(k + 1) for k in constant)
            warnings.warn(
                f"input {listed} of {rows.X.shape[2]} has the same value in every row: the network "
                "learns nothing from it, and predictions at other values of it mean nothing",
                ConstantInputWarning,
                stacklevel=4,
            )
        y_scale = _deviation(y_square, y_mean)
        x_scale, y_scale = (np.where(scale > 0, scale, 1.0) for scale in (x_scale, y_scale))
        return Scaling(x_mean, x_scale, y_mean, y_scale)

    def single(self, network: int) -> Scaling:
        """That of one network alone."""
        one = slice(network, network + 1)
        inputs = one if len(self.input_mean) > 1 else slice(None)
        return Scaling(
            self.input_mean[inputs],
            self.input_scale[inputs],
            self.target_mean[one],
            self.target_scale[one],
        )

    def inputs(self, X: FloatArray) -> FloatArray:
        """Standardised (1 or B, N, d) of (N, d) or (B, N, d)."""
        batch = X[None] if X.ndim == 2 else X
        return (batch - self.input_mean[:, None]) / self.input_scale[:, None]

    def targets(self, Y: FloatArray) -> FloatArray:
        """Standardised (B, N) of (N, B)."""
        return ((Y - self.target_mean) / self.target_scale).T

    def outputs(self, standard: FloatArray) -> FloatArray:
        """(N, B) in the unit of the target, of (B, N)."""
        return standard.T * self.target_scale + self.target_mean


def _deviation(square: FloatArray, mean: FloatArray) -> FloatArray:
    found = np.sqrt(square)
    found[found <= CONSTANT * np.abs(mean)] = 0.0
    return found


LEAST_GAIN = 1e-6
"""By this share a validation error must fall to be a better one; rounding makes it fall as well."""


class Training:
    """The networks of one batch while they are trained; each ends by itself."""

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
            raise FitError("the cost of the start weights is not finite", hint="scale the data")
        self._epochs: list[list[Epoch]] = [[] for _ in task.start]
        self._best_epoch = np.zeros(len(task.start), dtype=int)
        self._stopped = [""] * len(task.start)

    def run(self, callback: Callback | None = None) -> Result:
        """Train to the end: weights (B, P) and histories."""
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
        """(B,) mean square error and weight decay."""
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
        """One step for every network that is still trained, with as much damping as it needs."""
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
        """Remember where each network is; keep the best weights, and stop those that are done."""
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
        # Epoch 0 is the best so far when it is judged, and keeps its weights either way.
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
    """A linearised problem that can be solved for several dampings."""

    def step(self, damping: FloatArray) -> tuple[Array, BoolArray]:
        """Steps (B, P) for dampings (B,), and whether each could be computed."""


class Primal:
    """Unknowns are the weights: (JᵀJ + λ·1)·s = g."""

    def __init__(
        self, at: Linearised, residual: Array, weights: Array, decay: float, arrays: Arrays
    ) -> None:
        self._matrix = at.normal_matrix()
        self._target = at.transposed_times(residual) - decay * weights
        self._size = arrays.mean_diagonal(self._matrix)
        self._decay, self._arrays = decay, arrays

    def step(self, damping: FloatArray) -> tuple[Array, BoolArray]:
        """Steps (B, P)."""
        shift = self._decay + damping * self._size
        return self._arrays.solve(self._matrix, shift, self._target)


class Dual:
    """Unknowns are the rows."""

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
        """Steps (B, P)."""
        shift = self._decay + damping * self._size
        target = self._residual
        share = self._arrays.asarray(self._decay / np.maximum(shift, np.finfo(float).tiny))[:, None]
        if self._along is not None:
            target = target + share * self._along
        dual, definite = self._arrays.solve(self._matrix, shift, target)
        step = self._at.transposed_times(dual)
        return step - share * self._weights if self._along is not None else step, definite


def dual_is_faster(mlp: Mlp, rows: int) -> bool:
    """Whether the dual system is less work: multiplications to build and to factor it."""
    factors = sum(inputs + units for inputs, units in mlp.shapes)
    # Blocks of the kernel are small products, which run at about a third of the speed of a big one.
    dual = 3 * rows**2 * factors + rows**3 / 3
    primal = rows * mlp.n_weights**2 + mlp.n_weights**3 / 3
    return dual < primal


Result = tuple[FloatArray, tuple[History, ...]]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Networks to train together, the first of them with the number `first`."""

    mlp: Mlp
    rows: Rows
    validation: Rows | None
    scaling: Scaling
    start: FloatArray
    settings: Settings
    first: int = 0

    def single(self, network: int) -> Task:
        """Return the task of one network alone."""
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
        """Train, on one thread of BLAS."""
        with threadpool_limits(1):
            return Training(self).run(callback)


def run_all(task: Task, *, jobs: int, callback: Callback | None) -> Result:
    """Train all networks of a task.

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
            # Workers that report into a full pipe would wait for ever: read on until they end.
            ended.set()
            for future in futures:
                future.cancel()
            _follow(futures, reports, None)
            raise
    return [future.result() for future in futures]


POLL_S = 0.05
"""How often the epochs that workers report are passed on."""


def _follow(futures: list[Future[Result]], reports: Any, callback: Callback | None) -> None:
    pending = set(futures)
    while pending:
        _, pending = wait(pending, timeout=POLL_S)
        while not reports.empty():
            epoch = reports.get()
            if callback is not None:
                callback(epoch)


class _Ended(Exception):
    """The parent no longer needs the result."""


_report: Callable[[Epoch], None] | None = None
"""In a worker: passes an epoch on."""


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
