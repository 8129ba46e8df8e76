"""A residual network as C: one sample at a time, every layer remembers what its taps reach to.

It says what `hil.networks.residual.streaming` says, at rest as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hil.core import FitError
from hil.export import c_network_text as text
from hil.export.c_network_weights import BLOCK, CellWeights, cell_weights
from hil.export.c_text import Kind, Piece, array, number
from hil.networks import Correction, ResidualSettings

ARRAYS: dict[str, tuple[str, Kind]] = {
    "mean": ("means", "double"),
    "rate": ("rates", "double"),
    "lowest": ("lowest", "double"),
    "highest": ("highest", "double"),
    "enter_weight": ("enter", "float"),
    "enter_bias": ("enter_bias", "float"),
    "taps": ("taps", "float"),
    "bias": ("biases", "float"),
    "leave_weight": ("leave", "float"),
    "leave_bias": ("leave_bias", "float"),
    "share": ("share", "double"),
}
"""Name in C → attribute of `CellWeights`, and what it holds."""


def network_piece(correction: Correction, n: int) -> Piece:
    """`hil_network`: what the networks add to the effort of the physics, for one sample.

    The C function takes q [rad], qd [rad/s], qdd [rad/s²] and the effort `base` of the physics,
    `HIL_N` numbers each, and writes as many, 0 for joints that keep no network.

    Args:
        correction: Networks that hear no torque.
        n: Number of joints.

    Raises:
        FitError: The networks hear torque.
        ValueError: They are for another number of joints, or have weights that are not finite.
    """
    settings = correction.settings
    if settings.inputs != "motion":
        raise FitError(
            f"the residual network has inputs: {settings.inputs}, but a program knows the motion "
            "only",
            hint="fit residual with inputs: motion",
        )
    if len(correction.kept) != n:
        raise ValueError(f"networks of {len(correction.kept)} joints for a robot of {n}")
    if not np.any(correction.kept):
        return Piece(functions=text.NOTHING)
    weights = cell_weights(correction)
    width = weights.biases.shape[1]
    reach = [(settings.kernel - 1) * dilation + 1 for dilation in settings.dilations]
    cells = len(weights.enter)
    return Piece(
        constants=_constants(correction, weights, reach),
        state=(
            f"    int network_begun;\n    int network_at[{len(reach)}];\n"
            f"    float network_ring[{sum(reach)}][{cells * width}];\n"
        ),
        functions=_functions(correction),
        # The first sample fills the rings.
        reset="    s->network_begun = 0;\n",
    )


def _constants(correction: Correction, weights: CellWeights, reach: Sequence[int]) -> str:
    settings = correction.settings
    sizes = {
        "SETS": len(weights.means),
        "GROUPS": len(weights.means) // len(correction.networks),
        "INPUTS": weights.means.shape[1],
        "BRANCHES": settings.branches,
        "CELLS": len(weights.enter),
        "WIDTH": weights.biases.shape[1],
        "LAYERS": len(reach),
        "KERNEL": settings.kernel,
        "OUTPUTS": len(weights.leave) // len(weights.enter),
    }
    lines = ",\n".join(f"    HIL_NETWORK_{name} = {size}" for name, size in sizes.items())
    first = [0, *np.cumsum(reach)[:-1].tolist()]
    limit = np.where(correction.kept, correction.limit, 0.0)
    return "".join(
        [
            f"enum {{\n{lines}\n}};\n",
            _whole("dilation", settings.dilations),
            _whole("first", first),
            _whole("joint", weights.joints.tolist()),
            array("hil_network_limit", limit),
            *(
                array(f"hil_network_{name}", getattr(weights, attribute), kind)
                for name, (attribute, kind) in ARRAYS.items()
            ),
        ]
    )


def _whole(name: str, values: Sequence[int]) -> str:
    listed = ", ".join(str(int(value)) for value in values)
    return f"static const int hil_network_{name}[{len(values)}] = {{{listed}}};\n"


def _functions(correction: Correction) -> str:
    settings = correction.settings
    kept = [int(joint) for joint in np.flatnonzero(correction.kept)]
    own = settings.layout == "grouped"
    raw = _own_inputs(settings, kept) if own else _all_inputs(len(correction.kept))
    return "".join(
        [
            text.TANH if own or settings.activation == "tanh" else "",
            text.RELU if settings.activation == "relu" else "",
            text.CLIP,
            raw,
            text.ENTER,
            text.LAYER.replace("ACTIVATION", settings.activation),
            text.LEAVE,
            text.STEP,
        ]
    )


def _own_inputs(settings: ResidualSettings, kept: Sequence[int]) -> str:
    """Each kept joint's velocity, signs, acceleration and, if told, effort of the physics."""
    lines = []
    for joint in kept:
        signs = [_sign(joint, width) for width in settings.sign_widths]
        told = [f"base[{joint}]"] if settings.base_input else []
        lines.append([f"qd[{joint}]", *signs, f"qdd[{joint}]", *told])
    unused = ["q"] if settings.base_input else ["q", "base"]
    return _raw(lines, unused)


def _sign(joint: int, width: float) -> str:
    # Held within what a float can hold, and where the tangent no longer changes.
    scaled = f"hil_network_clip(qd[{joint}] / {number(width)}, -8.0, 8.0)"
    return f"(double)hil_network_tanh((float){scaled})"


def _all_inputs(n: int) -> str:
    listed = [f"{name}[{joint}]" for joint in range(n) for name in ("q", "qd", "qdd")]
    return _raw([listed], ["base"])


def _raw(groups: Sequence[Sequence[str]], unused: Sequence[str]) -> str:
    """The function that lists the inputs of each group, before they are scaled."""
    lines = [f"(void){name};" for name in unused]
    for group, inputs in enumerate(groups):
        size = len(inputs) + -len(inputs) % BLOCK
        full = [*inputs, *["0.0"] * (size - len(inputs))]
        lines += [f"raw[{group * size + k}] = {what};" for k, what in enumerate(full)]
    body = "".join(f"    {line}\n" for line in lines)
    return (
        "static void hil_network_raw(const double *q, const double *qd, const double *qdd,\n"
        f"                            const double *base, double *raw)\n{{\n{body}}}\n\n"
    )
