"""CPU time of one evaluation, and of one with its gradient by the weights, on one thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median

import torch
from torch import Tensor

from benchmarks.lagrangian_peers.layer_jacobian import LayerJacobian
from benchmarks.lagrangian_peers.torch_func import by_hessian, by_jvp
from hil.core.errors import FitError
from hil.networks.lagrangian import LagrangianNetwork

Torque = Callable[[Tensor, Tensor, Tensor], Tensor]
JOINTS = 6
SCALE = (22.0, 35.0, 19.5, 4.9, 4.15, 3.8)
AGREEMENT = 1e-9
"""Between everybody's torques in float64, relative to the largest."""


def contestants() -> dict[str, Torque]:
    """All with the same weights: a default network in single precision."""
    net = LagrangianNetwork(JOINTS, torque_scale=SCALE)
    _require_agreement(net)
    return _all(net)


def _all(net: LagrangianNetwork) -> dict[str, Torque]:
    return {
        "ours": net,
        "layer_jacobian": LayerJacobian(net, lean=False),
        "layer_jacobian_lean": LayerJacobian(net, lean=True),
        "torch_func_jvp": by_jvp(net),
        "torch_func_hessian": by_hessian(net),
    }


def _require_agreement(net: LagrangianNetwork) -> None:
    """Nobody may be quick with something else."""
    rows = [x.double() for x in motion(20)]
    net.double()
    with torch.no_grad():
        told = {name: torque(*rows) for name, torque in _all(net).items()}
    net.float()
    for name, found in told.items():
        away = float((found - told["ours"]).abs().max() / told["ours"].abs().max())
        if not away < AGREEMENT:
            raise FitError(f"{name} disagrees with ours by {away:.1e} in the benchmark lagrangian")


def motion(rows: int) -> list[Tensor]:
    """q, q̇, q̈ (rows, n)."""
    random = torch.Generator().manual_seed(0)
    return [size * torch.randn(rows, JOINTS, generator=random) for size in (1.5, 1.0, 3.0)]


def times(batch: int, budget_s: float, rounds: int) -> dict[str, float]:
    """Milliseconds by contestant and pass; contestants take turns, so that load meets all alike.

    Args:
        batch: Rows.
        budget_s: A contestant has no further turn once it has used this much.
        rounds: Turns at most, two at least; the median counts.
    """
    rows, passes = motion(batch), {"forward": _forward, "both": _both}
    told: dict[str, list[float]] = {}
    everybody = contestants()
    for turn in range(rounds + 1):
        for name, torque in everybody.items():
            for kind, once in passes.items():
                spent = told.setdefault(f"{name}_{kind}", [])
                if turn < 3 or sum(spent) < budget_s:
                    spent.append(_cpu(lambda t=torque, o=once: o(t, rows)))  # type: ignore[misc]
    return {key: 1e3 * median(spent[1:]) for key, spent in told.items()}


def _forward(torque: Torque, rows: list[Tensor]) -> None:
    with torch.no_grad():
        torque(*rows)


def _both(torque: Torque, rows: list[Tensor]) -> None:
    torque(*rows).square().mean().backward()


def _cpu(work: Callable[[], None]) -> float:
    begin = time.process_time()
    work()
    return time.process_time() - begin
