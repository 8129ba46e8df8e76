"""Levenberg–Marquardt as one writes it in torch: the Jacobian by `vmap(jacrev(…))`.

Scaling and damping rule are ours, so that it takes the same steps; float64.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from benchmarks.lm_peers.course import LAYERS, Problem, Stopwatch, Terms, contest, skip
from hil.networks.lm import Damping
from hil.networks.mlp import Mlp


def output_of() -> Callable[[Any, Any], Any]:
    """Return the network as a function of its weights (P,) and inputs (4,) or (N, 4)."""
    import torch

    shapes = Mlp(LAYERS).shapes

    def output(weights: Any, x: Any) -> Any:
        start, value = 0, x
        for layer, (inputs, units) in enumerate(shapes):
            matrix = weights[start : start + inputs * units].reshape(inputs, units)
            value = value @ matrix[:-1] + matrix[-1]
            value = torch.tanh(value) if layer < len(shapes) - 1 else value
            start += inputs * units
        return value[..., 0]

    return output


def jacobian_of(output: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """(N, P) derivative by the weights at inputs (N, 4)."""
    import torch

    found: Callable[[Any, Any], Any] = torch.func.vmap(torch.func.jacrev(output), in_dims=(None, 0))
    return found


def warm_up() -> None:
    """Warm torch up: its one-time initialisation is not part of the training."""
    import torch

    torch.set_num_threads(1)
    weights = torch.as_tensor(Mlp(LAYERS).initial(0))
    jacobian_of(output_of())(weights, torch.zeros((2, LAYERS[0]), dtype=weights.dtype))


def damped_step(H: Any, g: Any) -> Any:
    """H⁻¹g (P,), or None where H (P, P) is not positive definite: a step that failed."""
    import torch

    factor, failed = torch.linalg.cholesky_ex(H)
    return None if failed else torch.cholesky_solve(g[:, None], factor)[:, 0]


def solve(terms: Terms, rows: Problem, watch: Stopwatch) -> None:
    """Train to the target."""
    import torch

    output, rule = output_of(), Damping()
    jacobian = jacobian_of(output)
    X = torch.as_tensor(rows.scaling.inputs(rows.X)[0])
    Y = torch.as_tensor(rows.scaling.targets(rows.y[:, None])[0])
    weights, damping = torch.as_tensor(rows.start), rule.start
    unit = float(rows.scaling.target_scale[0])

    def cost_of(candidate: Any) -> float:
        return float(((Y - output(candidate, X)) ** 2).mean())

    cost = cost_of(weights)
    _note(watch, unit * cost**0.5)
    for _ in range(terms.iterations):
        J, residual = jacobian(weights, X), Y - output(weights, X)
        H, g = J.T @ J / len(Y), J.T @ residual / len(Y)
        identity = torch.diagonal(H).mean() * torch.eye(len(g), dtype=H.dtype)
        for _ in range(rule.tries):
            step = damped_step(H + damping * identity, g)
            trial = weights if step is None else weights + step
            if step is not None and (found := cost_of(trial)) < cost:
                weights, cost, damping = trial, found, damping / rule.fall
                break
            damping *= rule.rise
        _note(watch, unit * cost**0.5)


def _note(watch: Stopwatch, rmse: float) -> None:
    watch.note(lambda: rmse)


if __name__ == "__main__":
    if find_spec("torch") is None:
        skip("torch is not installed (pip install 'hil[learn]')")
    else:
        warm_up()
        contest(solve)
