"""A Lagrangian network as C: M(q), its rate along the motion and the gradients, written out.

One pass forwards carries the raw outputs and their rates, one backwards the gradient of T − V by q,
as in `hil.networks.lagrangian.network`. Layers are in the precision of the training, the few
products with L in double.
"""

from __future__ import annotations

from hil.export import c_dense_text as text
from hil.export.c_activations import NAMES, activation_functions, faded, typed
from hil.export.c_dense import Size, layer_constants, sized, sizes_of
from hil.export.c_text import Piece, array, number
from hil.export.lagrangian_terms import LagrangianTerms, NetworkFriction
from hil.export.program import Program


def lagrangian_piece(program: Program) -> Piece:
    """`hil_lagrangian`: adds M(q)·q̈ + C(q, q̇)·q̇ + g(q) [N·m] to what is in `torque`.

    The activations of a friction network are among its functions.
    """
    terms = program.lagrangian
    if terms is None:
        return Piece()
    sizes, kind = sizes_of(terms.trunk), terms.kind
    hidden, diagonal = NAMES[terms.activation], "relu" if terms.rectified else "softplus"
    wanted = {name + end for name in (hidden, diagonal) for end in ("", "_slope")}
    friction = program.friction
    if isinstance(friction, NetworkFriction) and len(friction.layers.weights) > 1:
        wanted.add("curve")
    return Piece(
        constants=layer_constants("trunk", terms.trunk, kind)
        + array("hil_row_unit", terms.unit)
        + array("hil_gravity_unit", terms.gravity_unit),
        functions=activation_functions(wanted, kind)
        + sized(text.FORWARD + text.BACK, sizes, kind)
        + sized(text.BEND, [(0, out) for _, out in sizes[:-1]], kind, terms.activation)
        + typed(_there(sizes) + _back(sizes), kind)
        + typed(_features(terms, sizes) + _torque(terms, sizes), kind),
    )


def _there(sizes: list[Size]) -> str:
    """Raw outputs and their rates from features and theirs, and the slopes of hidden layers."""
    hidden = sizes[:-1]
    lines = [f"REAL h{k}[{out}], d{k}[{out}];" for k, (_, out) in enumerate(hidden)]
    first = 0
    for k, (inputs, out) in enumerate(sizes):
        source = f"h{k - 1}, d{k - 1}" if k else "x, dx"
        target = f"h{k}, d{k}" if k < len(hidden) else "raw, rate"
        weights = f"hil_trunk_weight{k}, hil_trunk_bias{k}"
        lines.append(f"hil_along_{inputs}_{out}({weights}, {source}, {target});")
        if k < len(hidden):
            lines.append(f"hil_bend_{out}(h{k}, d{k}, slope + {first});")
            first += out
    body = "".join(f"    {line}\n" for line in lines)
    return (
        "static void hil_trunk(const REAL *x, const REAL *dx, REAL *raw, REAL *rate, REAL *slope)\n"
        f"{{\n{body}}}\n\n"
    )


def _back(sizes: list[Size]) -> str:
    """The gradient by the features of what has the gradient `pull` by the raw outputs."""
    hidden = sizes[:-1]
    lines = [f"REAL g{k}[{out}];" for k, (_, out) in enumerate(hidden)] + ["int i;"]
    first = sum(out for _, out in hidden)
    for k in reversed(range(len(sizes))):
        inputs, out = sizes[k]
        source = f"g{k}" if k < len(hidden) else "pull"
        target = f"g{k - 1}" if k else "found"
        lines.append(f"hil_back_{inputs}_{out}(hil_trunk_weight{k}, {source}, {target});")
        if k:
            first -= inputs
            bent = f"{target}[i] *= slope[{first} + i];"
            lines.append(f"for (i = 0; i < {inputs}; i++) {{ {bent} }}")
    body = "".join(f"    {line}\n" for line in lines)
    return (
        "static void hil_trunk_back(const REAL *pull, const REAL *slope, REAL *found)\n"
        f"{{\n{body}}}\n\n"
    )


def _features(terms: LagrangianTerms, sizes: list[Size]) -> str:
    n, inputs = len(terms.unit), sizes[0][0]
    places = 2 * n if terms.sincos else n
    made = TURNS if terms.sincos else AS_IT_IS
    # Room that was added stays 0.
    rest = f"    for (i = {places}; i < {inputs}; i++) {{ x[i] = dx[i] = ZERO; }}\n"
    return FEATURES.replace("MADE", made + (rest if places < inputs else ""))


def _torque(terms: LagrangianTerms, sizes: list[Size]) -> str:
    entries = len(terms.unit) * (len(terms.unit) + 1) // 2
    diagonal = "relu" if terms.rectified else "softplus"
    words = {
        "INPUTS": str(sizes[0][0]),
        "OUTPUTS": str(sizes[-1][1]),
        "SLOPES": str(sum(out for _, out in sizes[:-1])),
        "DIAGONAL": diagonal,
        "FADED": faded(diagonal, "raw[r]"),
        "LEAST": number(terms.least),
        "ADDED": number(terms.added),
        "POTENTIAL": UPHILL if terms.potential else "",
        "GRADIENT": TURNED if terms.sincos else STRAIGHT,
        "HEAD": "" if terms.potential else HEAD,
        "ENTRIES": str(entries),
    }
    code = TORQUE
    for word, value in words.items():
        code = code.replace(word, value)
    return code


FEATURES = """\
/* What the first layer sees of q, and the rates of that. */
static void hil_features(const double *q, const double *qd, REAL *x, REAL *dx)
{
    int i;
MADE}

"""

TURNS = """\
    for (i = 0; i < HIL_N; i++) {
        const double c = cos(q[i]), s = sin(q[i]);
        x[i] = (REAL)c;
        x[HIL_N + i] = (REAL)s;
        dx[i] = (REAL)(-s * qd[i]);
        dx[HIL_N + i] = (REAL)(c * qd[i]);
    }
"""

AS_IT_IS = """\
    for (i = 0; i < HIL_N; i++) { x[i] = (REAL)q[i]; dx[i] = (REAL)qd[i]; }
"""

TORQUE = """\
static void hil_lagrangian(const double *q, const double *qd, const double *qdd, double *torque)
{
    REAL x[INPUTS], dx[INPUTS], found[INPUTS], slope[SLOPES];
    REAL raw[OUTPUTS], rate[OUTPUTS], pull[OUTPUTS];
    double L[HIL_N][HIL_N], D[HIL_N][HIL_N], bent[HIL_N], u[HIL_N], w[HIL_N];
    int r, c, k = HIL_N;
    hil_features(q, qd, x, dx);
    hil_trunk(x, dx, raw, rate, slope);
    /* M = L L', D is the rate of L, u = L' qd, w = L' qdd + D' qd. */
    for (r = 0; r < HIL_N; r++) {
        const double unit = hil_row_unit[r];
        const REAL e = FADED;
        bent[r] = (double)hil_DIAGONAL_slope(raw[r], e);
        L[r][r] = ((double)hil_DIAGONAL(raw[r], e) + LEAST) * unit;
        D[r][r] = bent[r] * (double)rate[r] * unit;
        for (c = 0; c < r; c++, k++) {
            L[r][c] = (double)raw[k] * unit;
            D[r][c] = (double)rate[k] * unit;
        }
    }
    for (c = 0; c < HIL_N; c++) {
        u[c] = w[c] = 0.0;
        for (r = c; r < HIL_N; r++) {
            u[c] += L[r][c] * qd[r];
            w[c] += L[r][c] * qdd[r] + D[r][c] * qd[r];
        }
    }
    /* Gradient of the kinetic energy by the raw outputs: qd u'. */
    for (k = 0; k < OUTPUTS; k++) { pull[k] = ZERO; }
    k = HIL_N;
    for (r = 0; r < HIL_N; r++) {
        const double pushed = hil_row_unit[r] * qd[r];
        torque[r] += D[r][r] * u[r] + L[r][r] * w[r] + ADDED * qdd[r];
        pull[r] = (REAL)(bent[r] * pushed * u[r]);
        for (c = 0; c < r; c++, k++) {
            torque[r] += D[r][c] * u[c] + L[r][c] * w[c];
            pull[k] = (REAL)(pushed * u[c]);
        }
    }
POTENTIAL    hil_trunk_back(pull, slope, found);
    for (r = 0; r < HIL_N; r++) {
        torque[r] -= GRADIENT;
HEAD    }
}
"""

UPHILL = "    pull[ENTRIES] = (REAL)-hil_gravity_unit[0];\n"

TURNED = "(double)x[r] * (double)found[HIL_N + r] - (double)x[HIL_N + r] * (double)found[r]"

STRAIGHT = "(double)found[r]"

HEAD = "        torque[r] += hil_gravity_unit[r] * (double)raw[ENTRIES + r];\n"
