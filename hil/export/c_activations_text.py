"""C of activations and what they need, of which the precision `REAL` is filled in.

They have no branches, which would have loops computed one by one.
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
