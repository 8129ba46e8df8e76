"""Text of the self-test and of the CMake file beside a program."""

TEST = """/* Golden vectors of the model in Python. Build it with {p}.c and run it. */
#include "{header}"

#include <math.h>
#include <stdio.h>
#include <string.h>

{constants}
static double worst = 0.0, worst_own = 0.0;

/* The larger one; what is no number is larger than all, and stays. */
static double larger(double most, double off) {{ return off <= most ? most : off; }}

/* Golden motions: efforts, the same with parts, and whether these add up. */
static int compared(void)
{{
    {p}_state state, twin;
    {p}_parts parts;
    double effort[{P}_N], again[{P}_N];
    int load, i, j, wrong = 0;
    for (load = 0; load < 2; load++) {{
        {p}_reset(&state);
        {p}_reset(&twin);
        if (load && ({p}_set_load(&state, {mass}, com, inertia)
                     || {p}_set_load(&twin, {mass}, com, inertia))) {{ return 2; }}
        for (i = 0; i < {samples}; i++) {{
            const double *q = inputs[i][0], *qd = inputs[i][1], *qdd = inputs[i][2];
            if ({p}_step(&state, q, qd, qdd, effort, NULL)) {{ return 2; }}
            if ({p}_step(&twin, q, qd, qdd, again, &parts)) {{ return 2; }}
            for (j = 0; j < {P}_N; j++) {{
                const double physics = effort[j] - parts.residual[j];
                const double off = fabs(physics - wanted[load][i][j]) / largest[j];
                const double sum = {sum};
                const double apart = (fabs(sum - effort[j]) + fabs(again[j] - effort[j]))
                    / largest[j];
{residual}                /* Numbers behind one that is none do not make up for it. */
                if (!(off <= {most}) || !(apart <= 1e-9)) {{ wrong = 1; }}
                worst = larger(larger(worst, off), apart);
            }}
        }}
    }}
    return wrong;
}}

/* What is no number, or none that can be: refused, and nothing is changed by it. */
static int refused(void)
{{
    const double odd[4] = {{(double)NAN, (double)INFINITY, -2e6, 2e6}};
    {p}_state state, before;
    double in[3][{P}_N], effort[{P}_N], bad[6];
    int i, k;
    {p}_reset(&state);
    for (i = 0; i < 9; i++) {{
        const double *q = inputs[i][0], *qd = inputs[i][1], *qdd = inputs[i][2];
        if ({p}_step(&state, q, qd, qdd, effort, NULL)) {{ return 1; }}
    }}
    memcpy(&before, &state, sizeof state);
    for (k = 0; k < 4; k++) {{
        for (i = 0; i < 3 * {P}_N; i++) {{
            memcpy(in, inputs[9], sizeof in);
            in[i / {P}_N][i % {P}_N] = odd[k];
            effort[0] = 77.0;
            if ({p}_step(&state, in[0], in[1], in[2], effort, NULL) != -1) {{ return 1; }}
            if (!(effort[0] >= 77.0 && effort[0] <= 77.0)) {{ return 1; }}
        }}
        for (i = 0; i < 6; i++) {{ bad[i] = inertia[i]; }}
        bad[k] = odd[k];
        if ({p}_set_load(&state, odd[k], com, inertia) != -1) {{ return 1; }}
        if ({p}_set_load(&state, 1.0, com, bad) != -1) {{ return 1; }}
    }}
    if ({p}_set_load(&state, -1.0, com, inertia) != -1) {{ return 1; }}
    return memcmp(&before, &state, sizeof state) != 0;
}}

int main(void)
{{
    const int wrong = compared();
    if (wrong == 2) {{
        printf("a sample or a load that can be is refused\\n");
        return 2;
    }}
    printf("largest difference %.2e of each joint's largest effort", worst);
    if (worst_own > 0.0) {{ printf(", %.2e of the network's own", worst_own); }}
    printf("\\n");
    if (wrong) {{ return 1; }}
    if (refused()) {{
        printf("samples or loads that cannot be are taken, or leave something behind\\n");
        return 1;
    }}
    printf("%lu bytes of state\\n", (unsigned long)sizeof({p}_state));
    return 0;
}}
"""

NO_RESIDUAL = ""

RESIDUAL = """\
                const double own_off = fabs(parts.residual[j] - residuals[load][i][j]) / own[j];
                if (!(own_off <= {most})) {{ wrong = 1; }}
                worst_own = larger(worst_own, own_off);
                worst = larger(worst, fabs(physics - wanted[load][i][j] + parts.residual[j]
                                           - residuals[load][i][j]) / largest[j]);
"""

CMAKE = """cmake_minimum_required(VERSION 3.10)
project({p} C)
set(CMAKE_C_STANDARD 99)
set(CMAKE_C_EXTENSIONS OFF)
add_library({p} STATIC {p}.c)
target_include_directories({p} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
find_library(MATH m)
if(MATH)
  target_link_libraries({p} PUBLIC ${{MATH}})
endif()
enable_testing()
add_executable({p}_test {p}_test.c)
target_link_libraries({p}_test {p})
add_test(NAME golden COMMAND {p}_test)
"""
