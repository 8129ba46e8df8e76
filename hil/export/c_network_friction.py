"""Friction by a network of its own, dissipative or unconstrained, as C."""

from __future__ import annotations

from hil.export import c_dense_text as text
from hil.export.c_activations import typed
from hil.export.c_dense import Size, layer_constants, sized, sizes_of
from hil.export.c_text import Piece, array, number
from hil.export.lagrangian_terms import NetworkFriction


def network_friction_piece(friction: NetworkFriction) -> Piece:
    """`hil_friction_network`: friction [N·m] of q and q̇, memoryless.

    The function `hil_curve`, which it calls, comes with the Lagrangian network beside it.
    """
    sizes, kind = sizes_of(friction.layers), friction.kind
    last = DISSIPATIVE if friction.dissipative else UNCONSTRAINED
    inputs, outputs = sizes[0][0], sizes[-1][1]
    words = {
        "VELOCITY": "log(speed[i])" if friction.dissipative else "qd[i]",
        "SPEED": "    double speed[HIL_N], u[HIL_N];\n" if friction.dissipative else "",
        "REST": number(friction.rest_speed),
        "LAYERS": _layers(sizes),
        "LAST": last,
        "INPUTS": str(inputs),
        "OUTPUTS": str(outputs),
    }
    code = FRICTION.replace("SLOW", SLOW if friction.dissipative else "")
    for word, value in words.items():
        code = code.replace(word, value)
    return Piece(
        constants=layer_constants("friction", friction.layers, kind)
        + array("hil_friction_scale", friction.scale),
        functions=sized(text.VALUE, sizes, kind) + typed(code, kind),
    )


def _layers(sizes: list[Size]) -> str:
    """Hidden layers of tanh, and the last one."""
    lines = [f"REAL h{k}[{out}];" for k, (_, out) in enumerate(sizes[:-1])]
    lines += [f"REAL e{k}[{out}];" for k, (_, out) in enumerate(sizes[:-1])]
    lines += ["int i;"] * (len(sizes) > 1)
    for k, (inputs, out) in enumerate(sizes):
        source = f"h{k - 1}" if k else "x"
        target = f"h{k}" if k < len(sizes) - 1 else "out"
        weights = f"hil_friction_weight{k}, hil_friction_bias{k}"
        lines.append(f"hil_value_{inputs}_{out}({weights}, {source}, {target});")
        if k < len(sizes) - 1:
            lines += _curved(f"h{k}", f"e{k}", out)
    return "".join(f"    {line}\n" for line in lines)


def _curved(h: str, e: str, out: int) -> list[str]:
    """Loops of their own, as in `c_dense_text.FADE`."""
    loop = f"for (i = 0; i < {out}; i++)"
    return [
        f"{loop} {{ {e}[i] = hil_within(TWO * FABS({h}[i])); }}",
        f"{loop} {{ {h}[i] = hil_curve({h}[i], hil_decay({e}[i])); }}",
    ]


FRICTION = """\
static void hil_friction_layers(const REAL *x, REAL *out)
{
LAYERS}

static void hil_friction_network(const double *q, const double *qd, double *friction)
{
    REAL x[INPUTS], out[OUTPUTS];
SPEED    int i, c, k = 0;
    for (i = 0; i < INPUTS; i++) { x[i] = ZERO; }
    for (i = 0; i < HIL_N; i++) {
SLOW        x[i] = (REAL)cos(q[i]);
        x[HIL_N + i] = (REAL)sin(q[i]);
        x[2 * HIL_N + i] = (REAL)VELOCITY;
    }
    hil_friction_layers(x, out);
LAST}
"""

SLOW = "        speed[i] = fabs(qd[i]) + REST;\n"

UNCONSTRAINED = """\
    (void)c;
    (void)k;
    for (i = 0; i < HIL_N; i++) { friction[i] = (double)out[i] * hil_friction_scale[i]; }
"""

DISSIPATIVE = """\
    /* A A' qd, where the rows of A are divided by the roots of the speeds. */
    for (c = 0; c < HIL_N; c++) { u[c] = friction[c] = 0.0; }
    for (i = 0; i < HIL_N; i++) {
        for (c = 0; c <= i; c++, k++) {
            u[c] += (double)out[k] * hil_friction_scale[k] * qd[i] / sqrt(speed[i]);
        }
    }
    k = 0;
    for (i = 0; i < HIL_N; i++) {
        for (c = 0; c <= i; c++, k++) {
            friction[i] += (double)out[k] * hil_friction_scale[k] * u[c] / sqrt(speed[i]);
        }
    }
"""
