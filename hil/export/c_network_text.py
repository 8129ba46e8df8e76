"""The C functions of a streaming residual network, but for what its settings decide.

Arithmetic is in single precision, as the network was trained; inputs and the mean of the networks
are in double. What is not a number stays so, until it has left the window.
"""

TANH = """\
/* Within 4e-7 of the hyperbolic tangent: polynomials of x*x, fitted to it up to 8. */
static inline float hil_network_tanh(float x)
{
    float y, p, d;
    x = x < -8.0f ? -8.0f : x;
    x = x > 8.0f ? 8.0f : x;
    y = x * x;
    p = 1.0f + y * (1.34445086e-1f + y * (3.57160997e-3f
        + y * (2.18948608e-5f + y * 1.52306980e-8f)));
    d = 1.0f + y * (4.67778355e-1f + y * (2.61644889e-2f
        + y * (3.41131148e-4f + y * 8.52255994e-7f)));
    return x * p / d;
}

"""

RELU = """\
static inline float hil_network_relu(float x)
{
    return x < 0.0f ? 0.0f : x;
}

"""

CLIP = """\
static inline double hil_network_clip(double x, double lowest, double highest)
{
    x = x < lowest ? lowest : x;
    return x > highest ? highest : x;
}

"""

ENTER = """\
/* total += x @ w, four inputs at once; the channels that come out lie behind each other in w. */
static inline void hil_network_product(
    const float *HIL_RESTRICT w, const float *HIL_RESTRICT x, int inputs,
    float *HIL_RESTRICT total)
{
    int i, c;
    for (i = 0; i < inputs; i += 4) {
        const float *w0 = w + i * HIL_NETWORK_WIDTH;
        const float *w1 = w0 + HIL_NETWORK_WIDTH;
        const float *w2 = w1 + HIL_NETWORK_WIDTH;
        const float *w3 = w2 + HIL_NETWORK_WIDTH;
        const float x0 = x[i], x1 = x[i + 1], x2 = x[i + 2], x3 = x[i + 3];
        for (c = 0; c < HIL_NETWORK_WIDTH; c++) {
            total[c] += (w0[c] * x0 + w1[c] * x1) + (w2[c] * x2 + w3[c] * x3);
        }
    }
}

/* Inputs, scaled and held in the range of the training, as channels of all cells. */
static void hil_network_enter(const double *raw, float *h)
{
    int set, i, c;
    for (set = 0; set < HIL_NETWORK_SETS; set++) {
        const double *from = raw + (set % HIL_NETWORK_GROUPS) * HIL_NETWORK_INPUTS;
        float x[HIL_NETWORK_INPUTS];
        for (i = 0; i < HIL_NETWORK_INPUTS; i++) {
            const double scaled = (from[i] - hil_network_mean[set][i]) * hil_network_rate[set][i];
            x[i] = (float)hil_network_clip(
                scaled, hil_network_lowest[set][i], hil_network_highest[set][i]);
        }
        for (c = set * HIL_NETWORK_BRANCHES; c < (set + 1) * HIL_NETWORK_BRANCHES; c++) {
            float *total = h + c * HIL_NETWORK_WIDTH;
            for (i = 0; i < HIL_NETWORK_WIDTH; i++) {
                total[i] = hil_network_enter_bias[c][i];
            }
            hil_network_product(hil_network_enter_weight[c], x, HIL_NETWORK_INPUTS, total);
        }
    }
}

"""

LAYER = """\
/* Remembers h, and says where the taps of a layer are; the first sample lasted for ever. */
static void hil_network_remember(hil_state *s, int layer, const float *h, const float **taps)
{
    const int apart = hil_network_dilation[layer];
    const int reach = (HIL_NETWORK_KERNEL - 1) * apart + 1;
    float (*ring)[HIL_NETWORK_CELLS * HIL_NETWORK_WIDTH] =
        &s->network_ring[hil_network_first[layer]];
    int row = s->network_begun ? s->network_at[layer] : 0;
    const int last = s->network_begun ? row : reach - 1;
    int i;
    for (; row <= last; row++) {
        for (i = 0; i < HIL_NETWORK_CELLS * HIL_NETWORK_WIDTH; i++) {
            ring[row][i] = h[i];
        }
    }
    row = row < reach ? row : 0;
    s->network_at[layer] = row;
    for (i = 0; i < HIL_NETWORK_KERNEL; i++) {
        const int at = row + i * apart;
        taps[i] = ring[at < reach ? at : at - reach];
    }
}

static void hil_network_layer(hil_state *s, int layer, float *h)
{
    const float *taps[HIL_NETWORK_KERNEL];
    int cell, k, i;
    hil_network_remember(s, layer, h, taps);
    for (cell = 0; cell < HIL_NETWORK_CELLS; cell++) {
        const int number = layer * HIL_NETWORK_CELLS + cell;
        const int first = cell * HIL_NETWORK_WIDTH;
        float total[HIL_NETWORK_WIDTH];
        for (i = 0; i < HIL_NETWORK_WIDTH; i++) {
            total[i] = hil_network_bias[number][i];
        }
        for (k = 0; k < HIL_NETWORK_KERNEL; k++) {
            const float *w = hil_network_taps[number] + k * HIL_NETWORK_WIDTH * HIL_NETWORK_WIDTH;
            hil_network_product(w, taps[k] + first, HIL_NETWORK_WIDTH, total);
        }
        for (i = 0; i < HIL_NETWORK_WIDTH; i++) {
            h[first + i] += hil_network_ACTIVATION(total[i]);
        }
    }
}

"""

LEAVE = """\
/* The mean of the networks within its limits; 0 for joints that keep none. */
static void hil_network_leave(const float *h, double *out)
{
    int cell, k, i;
    for (i = 0; i < HIL_N; i++) {
        out[i] = 0.0;
    }
    for (cell = 0; cell < HIL_NETWORK_CELLS; cell++) {
        const float *from = h + cell * HIL_NETWORK_WIDTH;
        for (k = cell * HIL_NETWORK_OUTPUTS; k < (cell + 1) * HIL_NETWORK_OUTPUTS; k++) {
            const float *w = hil_network_leave_weight[k];
            float sum = hil_network_leave_bias[k];
            for (i = 0; i < HIL_NETWORK_WIDTH; i += 4) {
                sum += (w[i] * from[i] + w[i + 1] * from[i + 1])
                    + (w[i + 2] * from[i + 2] + w[i + 3] * from[i + 3]);
            }
            out[hil_network_joint[k]] += hil_network_share[k] * (double)sum;
        }
    }
    for (i = 0; i < HIL_N; i++) {
        out[i] = hil_network_clip(out[i], -hil_network_limit[i], hil_network_limit[i]);
    }
}

"""

STEP = """\
/* What the networks add to the effort `base` of the physics at this sample. */
static void hil_network(hil_state *s, const double *q, const double *qd, const double *qdd,
                        const double *base, double *out)
{
    double raw[HIL_NETWORK_GROUPS * HIL_NETWORK_INPUTS];
    float h[HIL_NETWORK_CELLS * HIL_NETWORK_WIDTH];
    int layer;
    hil_network_raw(q, qd, qdd, base, raw);
    hil_network_enter(raw, h);
    for (layer = 0; layer < HIL_NETWORK_LAYERS; layer++) {
        hil_network_layer(s, layer, h);
    }
    s->network_begun = 1;
    hil_network_leave(h, out);
}
"""

NOTHING = """\
/* No joint keeps its network. */
static void hil_network(hil_state *s, const double *q, const double *qd, const double *qdd,
                        const double *base, double *out)
{
    int i;
    (void)s;
    (void)q;
    (void)qd;
    (void)qdd;
    (void)base;
    for (i = 0; i < HIL_N; i++) {
        out[i] = 0.0;
    }
}
"""
