"""pyrenn's `train_LM`, as the static paper used it."""

from __future__ import annotations

import contextlib
import io
import warnings
from importlib.util import find_spec
from typing import Any

import numpy as np

from benchmarks.lm_peers.course import LAYERS, Problem, Stopwatch, Terms, contest, skip
from hil.core.typing import FloatArray
from hil.networks.mlp import Mlp


def pyrenn_module() -> Any:
    """Import the module without the warnings that its source causes in this Python."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pyrenn

    return pyrenn


def as_pyrenn(rows: Problem) -> FloatArray:
    """Convert the start weights (P,) to the order of pyrenn.

    Its vector has our order. It divides inputs and targets that exceed 1 by their largest
    magnitude, where we standardise: its first and last layer take up the difference.
    """
    weights, scaling = np.array(rows.start), rows.scaling
    matrices = Mlp(LAYERS).matrices(weights[None])
    first, last = matrices[0][0], matrices[-1][0]
    first[:-1] /= scaling.input_scale[0][:, None]
    first[-1] -= scaling.input_mean[0] @ first[:-1]
    first[:-1] *= np.maximum(np.abs(rows.X).max(axis=0), 1.0)[:, None]
    last *= scaling.target_scale[0]
    last[-1] += scaling.target_mean[0]
    last /= target_norm(rows)
    return weights


def target_norm(rows: Problem) -> float:
    """Return the factor by which pyrenn divides the target."""
    return max(float(np.abs(rows.y).max()), 1.0)


def solve(terms: Terms, rows: Problem, watch: Stopwatch) -> None:
    """Train for the iterations; its Jacobian and its cost are where we look at the clock."""
    pyrenn = pyrenn_module()
    net = pyrenn.CreateNN(list(LAYERS))
    net["w"] = as_pyrenn(rows)
    jacobian, cost = pyrenn.RTRL, pyrenn.calc_error

    def noted_jacobian(net: Any, data: Any) -> Any:
        found = jacobian(net, data)
        watch.note(lambda: target_norm(rows) * float(np.sqrt(found[1] / len(rows.y))))
        return found

    def limited_cost(net: Any, data: Any) -> Any:
        # Its inner loop tries steps until one succeeds, for ever if none does.
        watch.stop_when_over()
        return cost(net, data)

    pyrenn.RTRL, pyrenn.calc_error = noted_jacobian, limited_cost
    with contextlib.redirect_stdout(io.StringIO()):
        pyrenn.train_LM(rows.X.T, rows.y[None], net, k_max=terms.iterations, E_stop=0.0)


if __name__ == "__main__":
    if find_spec("pyrenn") is None:
        skip("pyrenn is not installed (pip install pyrenn)")
    else:
        pyrenn_module()
        contest(solve)
