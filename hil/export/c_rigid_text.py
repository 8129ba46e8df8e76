"""The C functions of a rigid body; what coupled motors add to them has a mark."""

COUPLED = {
    "@JOINTS@": """\
    double joints[3][HIL_N];
    for (i = 0; i < HIL_N; i++) {
        joints[0][i] = joints[1][i] = joints[2][i] = 0.0;
        for (k = 0; k < HIL_N; k++) {
            joints[0][i] += hil_coupling[i][k] * q[k];
            joints[1][i] += hil_coupling[i][k] * qd[k];
            joints[2][i] += hil_coupling[i][k] * qdd[k];
        }
    }
    q = joints[0]; qd = joints[1]; qdd = joints[2];
""",
    "@HELD@": "    double joint[HIL_N];\n",
    "@MOTORS@": """\
    for (i = 0; i < HIL_N; i++) { joint[i] = torque[i]; }
    for (i = 0; i < HIL_N; i++) {
        torque[i] = 0.0;
        for (k = 0; k < HIL_N; k++) { torque[i] += hil_coupling[k][i] * joint[k]; }
    }
""",
}
"""Where motors move more than one joint: joints = T motors, and motors hold T' times joints."""

FUNCTIONS = r"""
typedef struct {
    double turn[HIL_N][3][3]; /* from link i to link i - 1 */
    double shift[HIL_N][3];
    double spin[HIL_N][3], spin_rate[HIL_N][3], rise[HIL_N][3];
} hil_motion;

static void hil_cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void hil_into(double R[3][3], const double v[3], double out[3])
{
    int k;
    for (k = 0; k < 3; k++) { out[k] = R[0][k] * v[0] + R[1][k] * v[1] + R[2][k] * v[2]; }
}

static void hil_outof(double R[3][3], const double v[3], double out[3])
{
    int k;
    for (k = 0; k < 3; k++) { out[k] = R[k][0] * v[0] + R[k][1] * v[1] + R[k][2] * v[2]; }
}

/* Placement of a joint: the constant one, and behind it a turn by q about the axis (Rodrigues). */
static void hil_place(int i, double q, hil_motion *m)
{
    const double *a = hil_axis[i];
    double c = 1.0, s = 0.0, R[3][3];
    int j, k, l;
    if (hil_turns[i]) { c = cos(q); s = sin(q); }
    for (j = 0; j < 3; j++) {
        for (k = 0; k < 3; k++) { R[j][k] = a[j] * a[k] * (1.0 - c) + (j == k ? c : 0.0); }
    }
    R[0][1] -= a[2] * s; R[0][2] += a[1] * s;
    R[1][0] += a[2] * s; R[1][2] -= a[0] * s;
    R[2][0] -= a[1] * s; R[2][1] += a[0] * s;
    for (j = 0; j < 3; j++) {
        double moved = 0.0;
        for (k = 0; k < 3; k++) {
            double sum = 0.0;
            for (l = 0; l < 3; l++) { sum += hil_turn[i][j][l] * R[l][k]; }
            m->turn[i][j][k] = sum;
            moved += hil_turn[i][j][k] * a[k];
        }
        m->shift[i][j] = hil_shift[i][j] + (hil_turns[i] ? 0.0 : moved * q);
    }
}

/* Outwards: angular velocity and acceleration, and acceleration of each frame's origin. */
static void hil_move(const double *q, const double *qd, const double *qdd, hil_motion *m)
{
    double spin[3] = {0.0, 0.0, 0.0}, rate[3] = {0.0, 0.0, 0.0}, rise[3], t[3], u[3], v[3];
    int i, k;
@JOINTS@    for (k = 0; k < 3; k++) { rise[k] = -hil_gravity[k]; }
    for (i = 0; i < HIL_N; i++) {
        const double *a = hil_axis[i];
        hil_place(i, q[i], m);
        hil_cross(rate, m->shift[i], t);
        hil_cross(spin, m->shift[i], u);
        hil_cross(spin, u, v);
        for (k = 0; k < 3; k++) { t[k] += v[k] + rise[k]; }
        hil_into(m->turn[i], t, m->rise[i]);
        hil_into(m->turn[i], spin, u);
        hil_into(m->turn[i], rate, m->spin_rate[i]);
        for (k = 0; k < 3; k++) { v[k] = a[k] * qd[i]; m->spin[i][k] = u[k]; }
        hil_cross(u, v, t);
        for (k = 0; k < 3; k++) {
            if (hil_turns[i]) {
                m->spin[i][k] += v[k];
                m->spin_rate[i][k] += a[k] * qdd[i] + t[k];
            } else {
                m->rise[i][k] += a[k] * qdd[i] + 2.0 * t[k];
            }
        }
        for (k = 0; k < 3; k++) {
            spin[k] = m->spin[i][k]; rate[k] = m->spin_rate[i][k]; rise[k] = m->rise[i][k];
        }
    }
}

/* Inertia times v; b holds Ixx, Ixy, Iyy, Ixz, Iyz, Izz from index 4. */
static void hil_inert(const double *b, const double v[3], double out[3])
{
    out[0] = b[4] * v[0] + b[5] * v[1] + b[7] * v[2];
    out[1] = b[5] * v[0] + b[6] * v[1] + b[8] * v[2];
    out[2] = b[7] * v[0] + b[8] * v[1] + b[9] * v[2];
}

/* Inwards: what each joint holds, with these bodies and the load. */
static void hil_collect(hil_motion *m, const double (*bodies)[11], const double *load,
                        const double *qdd, double *torque)
{
    double force[3] = {0.0, 0.0, 0.0}, moment[3] = {0.0, 0.0, 0.0}, body[10], t[3], u[3], v[3];
@HELD@    int i, k;
    for (i = HIL_N - 1; i >= 0; i--) {
        const double *a = hil_axis[i], *b = bodies[i], *w = m->spin[i];
        double sum = 0.0;
        if (i == HIL_N - 1 && load) {
            for (k = 0; k < 10; k++) { body[k] = b[k] + load[k]; }
            b = body;
        }
        hil_cross(m->spin_rate[i], b + 1, t);
        hil_cross(w, b + 1, u);
        hil_cross(w, u, v);
        for (k = 0; k < 3; k++) { force[k] += b[0] * m->rise[i][k] + t[k] + v[k]; }
        hil_inert(b, m->spin_rate[i], t);
        hil_inert(b, w, u);
        hil_cross(w, u, v);
        hil_cross(b + 1, m->rise[i], u);
        for (k = 0; k < 3; k++) { moment[k] += t[k] + v[k] + u[k]; }
        for (k = 0; k < 3; k++) { sum += a[k] * (hil_turns[i] ? moment[k] : force[k]); }
        torque[i] = sum;
        hil_outof(m->turn[i], force, t);
        hil_outof(m->turn[i], moment, u);
        hil_cross(m->shift[i], t, v);
        for (k = 0; k < 3; k++) { force[k] = t[k]; moment[k] = u[k] + v[k]; }
    }
@MOTORS@    for (i = 0; i < HIL_N; i++) { torque[i] += bodies[i][10] * qdd[i]; }
}

/* A load told in the flange's frame becomes a body in the last link's. */
static void hil_mount(hil_state *s, double mass, const double com[3], const double inertia[6])
{
    static const int row[6] = {0, 1, 2, 0, 0, 1}, column[6] = {0, 1, 2, 1, 2, 2};
    static const int place[3][3] = {{4, 5, 7}, {5, 6, 8}, {7, 8, 9}};
    double I[3][3], R[3][3], T[3][3], c[3], square;
    int j, k, l;
    for (k = 0; k < 6; k++) { I[row[k]][column[k]] = I[column[k]][row[k]] = inertia[k]; }
    for (j = 0; j < 3; j++) {
        c[j] = hil_flange[j][3];
        for (k = 0; k < 3; k++) { R[j][k] = hil_flange[j][k]; c[j] += R[j][k] * com[k]; }
    }
    for (j = 0; j < 3; j++) {
        for (k = 0; k < 3; k++) {
            T[j][k] = 0.0;
            for (l = 0; l < 3; l++) { T[j][k] += R[j][l] * I[l][k]; }
        }
    }
    square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2];
    s->load[0] = mass;
    for (j = 0; j < 3; j++) {
        s->load[1 + j] = mass * c[j];
        for (k = 0; k <= j; k++) {
            double sum = mass * ((j == k ? square : 0.0) - c[j] * c[k]);
            for (l = 0; l < 3; l++) { sum += T[j][l] * R[k][l]; }
            s->load[place[j][k]] = sum;
        }
    }
}
"""
