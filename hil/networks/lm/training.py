"""The epochs of a batch of networks: linearise, step with enough damping, judge, stop."""

from __future__ import annotations

import numpy as np

from hil.core import BoolArray, FitError, FloatArray, SpecError
from hil.networks.lm.arrays import Arrays, NumpyArrays, Precision
from hil.networks.lm.network import Mlp, Pass
from hil.networks.lm.rows import Rows
from hil.networks.lm.scaling import Scaling
from hil.networks.lm.settings import Settings
from hil.networks.lm.steps import Dual, Primal, System, dual_is_faster
from hil.networks.lm.trained import Callback, Epoch, History

LEAST_GAIN = 1e-6
"""By this share a validation error must fall to be a better one; rounding makes it fall as well."""


class Training:
    """The networks of one batch while they are trained; each ends by itself."""

    def __init__(
        self,
        mlp: Mlp,
        rows: Rows,
        validation: Rows | None,
        scaling: Scaling,
        start: FloatArray,
        settings: Settings,
        first: int = 0,
    ) -> None:
        self._mlp, self._settings, self._scaling, self._first = mlp, settings, scaling, first
        self._arrays: Arrays = arrays_on(settings.device, settings.precision)
        self._rows, self._held_out = rows, validation
        self._X = self._arrays.inputs(scaling.inputs(rows.X))
        self._Y = self._arrays.asarray(scaling.targets(rows.Y))
        self._root = self._arrays.asarray(np.sqrt(rows.weight))
        if validation is not None:
            self._X_held_out = self._arrays.inputs(scaling.inputs(validation.X))
        self._dual = settings.solver == "dual" or (
            settings.solver == "auto" and dual_is_faster(mlp, len(rows))
        )
        self._weights = np.array(start)
        self._best = np.array(start)
        self._damping = np.full(len(start), float(settings.damping.start))
        self._passed = self._forward(self._weights)
        self._cost = self._cost_of(self._weights, self._passed)
        if not np.all(np.isfinite(self._cost)):
            raise FitError("the cost of the start weights is not finite", hint="scale the data")
        self._epochs: list[list[Epoch]] = [[] for _ in start]
        self._best_epoch = np.zeros(len(start), dtype=int)
        self._stopped = [""] * len(start)

    def run(self, callback: Callback | None = None) -> tuple[FloatArray, tuple[History, ...]]:
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


def arrays_on(device: str, precision: Precision) -> Arrays:
    """Arrays on `cpu` (numpy), or on a device of torch: `cuda`, `cuda:1`, `torch-cpu`.

    Raises:
        SpecError: torch is missing, or has no such device.
    """
    if device == "cpu":
        return NumpyArrays(precision)
    try:
        from hil.networks.lm.torch_arrays import TorchArrays
    except ImportError as error:
        raise SpecError(
            f"device {device!r} needs torch, which is not installed",
            hint='pip install "hil[learn]", or use device: cpu',
        ) from error
    return TorchArrays(device.removeprefix("torch-"), precision)
