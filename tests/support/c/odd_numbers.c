/* Feeds a program what no controller should: odd numbers, with traps armed. */
#define _GNU_SOURCE
#include "hil.h"
#include <fenv.h>
#include <math.h>
#include <stdio.h>
#include <string.h>

/* The first are allowed, those behind are refused. */
#define ALLOWED 20
#define ODD 28
static const double odd[ODD] = {
    0.0, -0.0, 0.3, -0.3, 1.0, -2.0, 1e-9, -1e-9, 1e-320, -1e-320, 2.2250738585072014e-308,
    -2.2250738585072014e-308, 1e-150, 3.2, 100.0, -100.0, 12345.678, -12345.678, 1e6, -1e6,
    1000000.1, -1000000.1, 1e300, -1e300, (double)INFINITY, -(double)INFINITY, (double)NAN,
    -(double)NAN
};
static unsigned long drawn = 88172645463325252UL;

static int below(int n)
{
    drawn ^= drawn << 13; drawn ^= drawn >> 7; drawn ^= drawn << 17;
    return (int)(drawn % (unsigned long)n);
}

/* Fills v and says whether all of it is allowed. */
static int draw(double *v, int count, int hostile)
{
    int i, fine = 1, spoilt = hostile ? below(count) : -1;
    for (i = 0; i < count; i++) {
        const int at = i == spoilt ? ALLOWED + below(ODD - ALLOWED) : below(ALLOWED);
        v[i] = odd[at];
        if (at >= ALLOWED) { fine = 0; }
    }
    return fine;
}

static int stepped(hil_state *s, int hostile)
{
    double in[3 * HIL_N], effort[HIL_N];
    hil_state before = *s;
    hil_parts parts;
    int i, said, fine = draw(in, 3 * HIL_N, hostile);
    for (i = 0; i < HIL_N; i++) { effort[i] = 77.0; }
    said = hil_step(s, in, in + HIL_N, in + 2 * HIL_N, effort, below(2) ? &parts : NULL);
    if (said != (fine ? 0 : -1)) { return 2; }
    if (!fine && memcmp(&before, s, sizeof before) != 0) { return 3; }
    for (i = 0; i < HIL_N; i++) {
        if (!isfinite(effort[i]) || (!fine && memcmp(&effort[i], &(double){77.0}, 8) != 0)) {
            return 4;
        }
    }
    return 0;
}

static int mounted(hil_state *s, int hostile)
{
    double mass, com[3], inertia[6];
    hil_state before = *s;
    int fine = draw(&mass, 1, hostile && below(2)), said;
    fine = draw(com, 3, hostile && below(2)) && fine;
    fine = draw(inertia, 6, hostile && below(2)) && fine;
    said = hil_set_load(s, mass, com, inertia);
    if (said != (fine && !(mass < 0.0) ? 0 : -1)) { return !fine || said != -1 ? 5 : 0; }
    return said && memcmp(&before, s, sizeof before) != 0 ? 6 : 0;
}

int main(void)
{
    static hil_state s;
    int k, wrong;
#ifdef __GLIBC__
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
#endif
    hil_reset(&s);
    for (k = 0; k < 6000; k++) {
        if (k % 500 == 0) { hil_reset(&s); }
        if (k % 7 == 0 && (wrong = mounted(&s, k % 3 == 0)) != 0) { return wrong; }
        if ((wrong = stepped(&s, k % 4 == 0)) != 0) { return wrong; }
    }
    puts("nothing stops it");
    return 0;
}
