/* Calls a program on a stack that it has painted, and prints how deep the paint is gone. */
#define _GNU_SOURCE
#include "hil.h"
#include <pthread.h>
#include <stdio.h>
#include <string.h>

#define ROOM (1 << 20)
#define PAINT 0xa5

static _Alignas(64) unsigned char stack[ROOM];
static hil_state s;
static unsigned char *from;

static void *called(void *nothing)
{
    static const double com[3] = {0.02, -0.03, 0.06}, inertia[6] = {1e-3, 1e-3, 1e-3, 0, 0, 0};
    static const double still[HIL_N] = {0};
    static double q[HIL_N], qd[HIL_N], qdd[HIL_N], effort[HIL_N];
    static hil_parts parts;
    static int k, i;
    volatile unsigned char here = 0;
    from = (unsigned char *)&here;
    hil_reset(&s);
    hil_step(&s, still, still, still, effort, &parts);
    hil_set_load(&s, 1.5, com, inertia);
    for (k = 0; k < 400; k++) {
        /* Small and large, both ways round. */
        const double size = k % 5 ? 1.0 : 1e5;
        for (i = 0; i < HIL_N; i++) {
            q[i] = size * (k - 200 + i) / 70.0; qd[i] = (k % 40 - 20 + i) / 8.0; qdd[i] = -qd[i];
        }
        hil_step(&s, q, qd, qdd, effort, k % 2 ? &parts : NULL);
    }
    return nothing;
}

int main(void)
{
    pthread_attr_t how;
    pthread_t thread;
    long k = 0;
    memset(stack, PAINT, ROOM);
    if (pthread_attr_init(&how) || pthread_attr_setstack(&how, stack, ROOM)) { return 2; }
    if (pthread_create(&thread, &how, called, NULL) || pthread_join(thread, NULL)) { return 3; }
    while (stack[k] == PAINT) { k++; }
    printf("%ld\n", (long)(from - &stack[k]));
    return 0;
}
