"""Training B networks to B targets by Levenberg–Marquardt."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hil.core import FitError, FloatArray, SpecError
from hil.networks.lm.network import Mlp
from hil.networks.lm.parallel import Task, run_all
from hil.networks.lm.rows import checked_rows, require_alike
from hil.networks.lm.scaling import Scaling
from hil.networks.lm.settings import Settings
from hil.networks.lm.trained import Callback, Trained


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
            changes neither gradient nor minimum (`hil.networks.lm.rows`).
        validation: (X, Y), (X, Y, weight) or (X, Y, weight, groups): rows to stop by.
        seed: For the start weights; network b draws its own from (seed, b).
        initial: Start weights (B, P) instead.
        jobs: Processes to spread the networks over. They are started by `forkserver` or `spawn`,
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
