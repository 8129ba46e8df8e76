"""C of fully connected layers, of which sizes and precision are filled in: `REAL`, `IN`, `OUT`.

Loops go over neighbours in memory with a count that the compiler knows, so that it computes several
at once without being allowed to reorder sums. One copy of the weights serves both ways: there the
outputs lie behind each other, on the way back sixteen partial sums of each input do. Activations
have no branches, which would have loops computed one by one.
"""

FORWARD = """\
/* y = b + x w, and the same of the rates dx without b. */
static void hil_along_IN_OUT(const REAL *restrict w, const REAL *restrict b,
                             const REAL *restrict x, const REAL *restrict dx,
                             REAL *restrict y, REAL *restrict dy)
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
static void hil_value_IN_OUT(const REAL *restrict w, const REAL *restrict b,
                             const REAL *restrict x, REAL *restrict y)
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
static void hil_back_IN_OUT(const REAL *restrict w, const REAL *restrict y, REAL *restrict x)
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
static void hil_bend_OUT(REAL *restrict y, REAL *restrict dy, REAL *restrict slope)
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

WITHIN = """\
/* e to the -80 is as good as e to the minus infinity. */
static inline REAL hil_within(REAL y) { return y < EIGHTY ? y : EIGHTY; }

"""

DECAY_FLOAT = """\
/* e to the -y for y from 0 to 80 (a Taylor series between powers of 2), within 2e-7 of it. */
static inline float hil_decay(float y)
{
    union { float number; uint32_t bits; } power;
    float r, p;
    int n;
    n = (int)(y * 1.44269504f + 0.5f);
    r = ((float)n * 0.693359375f - y) - (float)n * 2.12194440e-4f;
    p = 1.0f + r * (1.0f + r * (0.5f + r * (1.66666667e-1f + r * (4.16666667e-2f
        + r * (8.33333333e-3f + r * 1.38888889e-3f)))));
    power.bits = (uint32_t)(127 - n) << 23;
    return p * power.number;
}

"""

DECAY_DOUBLE = """\
static inline double hil_decay(double y) { return exp(-y); }

"""

LOG1P_FLOAT = """\
/* log(1 + e) for e from 0 to 1: a series of the inverse hyperbolic tangent. */
static inline float hil_log1p(float e)
{
    const float s = e / (2.0f + e), z = s * s;
    return 2.0f * s * (1.0f + z * (3.33333333e-1f + z * (0.2f + z * (1.42857143e-1f
        + z * (1.11111111e-1f + z * (9.09090909e-2f + z * 7.69230769e-2f))))));
}

"""

LOG1P_DOUBLE = """\
static inline double hil_log1p(double e) { return log1p(e); }

"""

SOFTPLUS = """\
static inline REAL hil_softplus(REAL x, REAL e) { return HALF * (x + FABS(x)) + hil_log1p(e); }

"""

SOFTPLUS_SLOPE = """\
static inline REAL hil_softplus_slope(REAL x, REAL e)
{
    return HALF + COPYSIGN(HALF - e / (ONE + e), x);
}

"""

SILU = """\
static inline REAL hil_silu(REAL x, REAL e) { return x * hil_softplus_slope(x, e); }

"""

SILU_SLOPE = """\
static inline REAL hil_silu_slope(REAL x, REAL e)
{
    const REAL gate = hil_softplus_slope(x, e);
    return gate + x * gate * (ONE - gate);
}

"""

CURVE = """\
/* The hyperbolic tangent; here e is e to the -2 |x|, and to the -|x| everywhere else. */
static inline REAL hil_curve(REAL x, REAL e) { return COPYSIGN((ONE - e) / (ONE + e), x); }

"""

CURVE_SLOPE = """\
static inline REAL hil_curve_slope(REAL x, REAL e)
{
    const REAL value = hil_curve(x, e);
    return ONE - value * value;
}

"""

RELU = """\
static inline REAL hil_relu(REAL x, REAL e)
{
    (void)e;
    return HALF * (x + FABS(x));
}

"""

RELU_SLOPE = """\
static inline REAL hil_relu_slope(REAL x, REAL e)
{
    (void)e;
    return x > ZERO ? ONE : ZERO;
}

"""
