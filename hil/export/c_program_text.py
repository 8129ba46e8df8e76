"""Text of header and source of a program, with marks for what depends on the model."""

RESTRICT = """\
/* What C calls restrict is no word of C++ or of MSVC. */
#if defined(_MSC_VER) || defined(__cplusplus)
#define HIL_RESTRICT __restrict
#else
#define HIL_RESTRICT restrict
#endif

"""

HEADER = """#ifndef HIL_MODEL_H
#define HIL_MODEL_H

/* Joints: {joints}. {units} */
#define HIL_N {n}

#ifdef __cplusplus
extern "C" {{
#endif

typedef struct {{
{state}}} hil_state;

/* Parts of an effort; they add up to it. */
typedef struct {{
{parts}}} hil_parts;

/* Before the first sample, and whenever samples stop coming. The load is taken off. */
void hil_reset(hil_state *s);

/* What is mounted: mass [kg], centre of mass [m] in the flange's frame, inertia about it
   (xx, yy, zz, xy, xz, yz) [kg*m2]. Returns 0, or -1 and changes nothing where a number is not
   finite or beyond 1e6, or the mass is below 0. Whether a body can have such an inertia is not
   looked at. */
int hil_set_load(hil_state *s, double mass, const double com[3], const double inertia[6]);
{warmth}
/* One sample in, one effort per joint out. `parts` may be NULL. Returns 0, or -1 if an input is
   not finite or beyond 1e6; then nothing is written and nothing remembered. */
int hil_step(hil_state *s, const double q[HIL_N], const double qd[HIL_N], const double qdd[HIL_N],
             double effort[HIL_N], hil_parts *parts);

#ifdef __cplusplus
}}
#endif

#endif
"""

SET_WARMTH = """
/* How much warmer than in the training each joint is [K]; friction depends on it. 0 after
   hil_reset. Returns 0, or -1 and changes nothing where one is not finite or beyond 1e6. */
int hil_set_warmth(hil_state *s, const double kelvin[HIL_N]);
"""

TAKE_WARMTH = """
static int hil_finite(const double *v, int count);

int hil_set_warmth(hil_state *s, const double kelvin[HIL_N])
{
    int i;
    if (!hil_finite(kelvin, HIL_N)) { return -1; }
    for (i = 0; i < HIL_N; i++) { s->warmer_k[i] = kelvin[i]; }
    return 0;
}
"""

NETWORK = """    hil_network(s, q, qd, qdd, effort, residual);
    for (i = 0; i < HIL_N; i++) { effort[i] += residual[i]; }
"""

LEARNED = {
    "@LEARNED@": "    hil_lagrangian(q, qd, qdd, rigid);\n",
    "@LEARNED_BARE@": "    hil_lagrangian(q, qd, qdd, bare);\n",
    "@LEARNED_GRAVITY@": "    hil_lagrangian(q, still, still, parts->gravity);\n",
}
"""What a Lagrangian network adds to bodies that are nothing but the load."""

STEP = r"""
/* Within 1e6, by the bits: to compare what is no number is an invalid operation, and traps. */
static int hil_finite(const double *v, int count)
{
    union { double number; unsigned long long bits; } size, most;
    int i;
    most.number = 1e6;
    for (i = 0; i < count; i++) {
        size.number = v[i];
        size.bits &= 0x7fffffffffffffffULL;
        if (size.bits > most.bits) { return 0; }
    }
    return 1;
}

int hil_set_load(hil_state *s, double mass, const double com[3], const double inertia[6])
{
    if (!hil_finite(&mass, 1) || mass < 0.0 || !hil_finite(com, 3) || !hil_finite(inertia, 6)) {
        return -1;
    }
    hil_mount(s, mass, com, inertia);
    return 0;
}

static void hil_explain(hil_motion *m, const double *q, const double *qd, const double *qdd,
                        const double *rigid, hil_parts *parts)
{
    static const double still[HIL_N] = {0.0};
    double bare[HIL_N];
    int i;
    (void)qd;
    hil_collect(m, hil_bodies, NULL, qdd, bare);
@LEARNED_BARE@    hil_move(q, still, still, m);
    hil_collect(m, hil_bodies, NULL, still, parts->gravity);
@LEARNED_GRAVITY@    for (i = 0; i < HIL_N; i++) {
        parts->load[i] = (rigid[i] - bare[i]) * hil_scale[i];
        parts->inertia[i] = (bare[i] - parts->gravity[i]) * hil_scale[i];
        parts->gravity[i] *= hil_scale[i];
    }
}

int hil_step(hil_state *s, const double q[HIL_N], const double qd[HIL_N], const double qdd[HIL_N],
             double effort[HIL_N], hil_parts *parts)
{
    hil_motion m;
    double rigid[HIL_N], friction[HIL_N], ripple[HIL_N], drive[HIL_N], residual[HIL_N]@DECLARED@;
    int i;
    if (!hil_finite(q, HIL_N) || !hil_finite(qd, HIL_N) || !hil_finite(qdd, HIL_N)) { return -1; }
    for (i = 0; i < HIL_N; i++) { friction[i] = ripple[i] = drive[i] = residual[i] = 0.0; }
    hil_move(q, qd, qdd, &m);
    hil_collect(&m, hil_bodies, s->load, qdd, rigid);
@LEARNED@@SECOND@    hil_friction(s, q, qd, @TRANSMITTED@, friction, ripple, drive);
    for (i = 0; i < HIL_N; i++) {
        effort[i] = (rigid[i] + friction[i] + ripple[i] + drive[i]) * hil_scale[i];
    }
@NETWORK@    if (parts) {
        hil_explain(&m, q, qd, qdd, rigid, parts);
        for (i = 0; i < HIL_N; i++) {
            parts->friction[i] = friction[i] * hil_scale[i];
            parts->ripple[i] = ripple[i] * hil_scale[i];
            parts->drive[i] = drive[i] * hil_scale[i];
            parts->residual[i] = residual[i];
        }
    }
    return 0;
}
"""
