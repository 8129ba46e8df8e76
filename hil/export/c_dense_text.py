"""C of fully connected layers, of which sizes and precision are filled in: `REAL`, `IN`, `OUT`.

Loops go over neighbours in memory with a count that the compiler knows, so that it computes several
at once without being allowed to reorder sums. One copy of the weights serves both ways: there the
outputs lie behind each other, on the way back sixteen partial sums of each input do. Activations
have no branches, which would have loops computed one by one.
"""

FORWARD = """\
/* y = b + x w, and the same of the rates dx without b. */
static void hil_along_IN_OUT(const REAL *HIL_RESTRICT w, const REAL *HIL_RESTRICT b,
                             const REAL *HIL_RESTRICT x, const REAL *HIL_RESTRICT dx,
                             REAL *HIL_RESTRICT y, REAL *HIL_RESTRICT dy)
{
    int i, c;
    for (c = 0; c < OUT; c++) { y[c] = b[c]; dy[c] = ZERO; }
    for (i = 0; i < IN; i += 4) {
        const REAL *w0 = w + i * OUT, *w1 = w0 + OUT, *w2 = w1 + OUT, *w3 = w2 + OUT;
        const REAL x0 = x[i], x1 = x[i + 1], x2 = x[i + 2], x3 = x[i + 3];
        const REAL d0 = dx[i], d1 = dx[i + 1], d2 = dx[i + 2], d3 = dx[i + 3];
        for (c = 0; c < OUT; c++) {
            y[c] += (w0[c] * x0 + w1[c] * x1) + (w2[c] * x2 + w3[c] * x3);
            dy[c] += (w0[c] * d0 + w1[c] * d1) + (w2[c] * d2 + w3[c] * d3);
        }
    }
}

"""

VALUE = """\
/* y = b + x w. */
static void hil_value_IN_OUT(const REAL *HIL_RESTRICT w, const REAL *HIL_RESTRICT b,
                             const REAL *HIL_RESTRICT x, REAL *HIL_RESTRICT y)
{
    int i, c;
    for (c = 0; c < OUT; c++) { y[c] = b[c]; }
    for (i = 0; i < IN; i += 4) {
        const REAL *w0 = w + i * OUT, *w1 = w0 + OUT, *w2 = w1 + OUT, *w3 = w2 + OUT;
        const REAL x0 = x[i], x1 = x[i + 1], x2 = x[i + 2], x3 = x[i + 3];
        for (c = 0; c < OUT; c++) {
            y[c] += (w0[c] * x0 + w1[c] * x1) + (w2[c] * x2 + w3[c] * x3);
        }
    }
}

"""

BACK = """\
/* x = w y: the gradient by the inputs of what has the gradient y by the outputs. */
static void hil_back_IN_OUT(const REAL *HIL_RESTRICT w, const REAL *HIL_RESTRICT y,
                            REAL *HIL_RESTRICT x)
{
    int i, l;
    for (i = 0; i < IN; i += 4) {
        const REAL *w0 = w + i * OUT, *w1 = w0 + OUT, *w2 = w1 + OUT, *w3 = w2 + OUT;
        REAL t0[LANES], t1[LANES], t2[LANES], t3[LANES];
PRODUCTSFOLDS        x[i] = (t0[0] + t0[1]) + (t0[2] + t0[3]);
        x[i + 1] = (t1[0] + t1[1]) + (t1[2] + t1[3]);
        x[i + 2] = (t2[0] + t2[1]) + (t2[2] + t2[3]);
        x[i + 3] = (t3[0] + t3[1]) + (t3[2] + t3[3]);
    }
}

"""

AT_ONCE = """\
        for (l = 0; l < LANES; l++) {
SUMS        }
"""
"""All outputs in one expression; twice as fast with clang as a loop that goes round once."""

IN_CHUNKS = """\
        int c;
        for (l = 0; l < LANES; l++) { t0[l] = t1[l] = t2[l] = t3[l] = ZERO; }
        for (c = 0; c < OUT; c += CHUNK) {
            for (l = 0; l < LANES; l++) {
SUMS            }
        }
"""

BEND = """\
/* Activation of a layer: values, and rates by its slopes, which the way back needs again. */
static void hil_bend_OUT(REAL *HIL_RESTRICT y, REAL *HIL_RESTRICT dy, REAL *HIL_RESTRICT slope)
{
    REAL e[OUT];
    int c;
FADE    for (c = 0; c < OUT; c++) {
        const REAL total = y[c];
        y[c] = hil_ACTIVATION(total, e[c]);
        slope[c] = hil_ACTIVATION_slope(total, e[c]);
        dy[c] *= slope[c];
    }
}

"""

FADE = """\
    /* In loops of their own: a limit and what follows it would make branches of one loop. */
    for (c = 0; c < OUT; c++) { e[c] = hil_within(TIMES * FABS(y[c])); }
    for (c = 0; c < OUT; c++) { e[c] = hil_decay(e[c]); }
"""

NO_FADE = """\
    for (c = 0; c < OUT; c++) { e[c] = ZERO; }
"""
