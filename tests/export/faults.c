/* Steps of law.c over its recorded samples, beside them with faults: missing and impossible readings
   and states, a gate passed at no time. Prints the largest difference of the commands after the
   faults, and the largest command; fails if a command or a number of the law is not finite, or a
   command beyond its limits. */
#include <stdio.h>

#include "law.c"
#include "law_samples.h"

static const double lowest[] = LOWEST, highest[] = HIGHEST;

enum { INPUTS = LAW_SENSORS + LAW_GIVEN_STATES, FIRST = SAMPLES / 8, LAST = SAMPLES / 4 };

/* The numbers of the law come first in its state, its whole numbers after them. */
static int is_finite(const law_state *s, const real *commands)
{
    const real *numbers = (const real *)s;
    int i, finite = 1;
    for (i = 0; i < NUMBERS; i++) finite = finite && numbers[i] - numbers[i] == 0;
    for (i = 0; i < LAW_COMMANDS; i++) finite = finite && commands[i] - commands[i] == 0;
    return finite;
}

static void step(law_state *s, int k, int faulty, real *commands)
{
    const real faults[] = {NAN, INFINITY, (real)-1e35, (real)WILD};
    real measurements[INPUTS + 1] = {0};
    int i;
    for (i = 0; i < INPUTS; i++) {
        measurements[i] = (real)sample_measurements[k * INPUTS + i];
        /* Each fault at one reading alone, then at all of them. */
        if (faulty && ((k / 4) % 3 == 2 || i == k % INPUTS)) measurements[i] = faults[k % 4];
    }
#ifdef GATED
    if (faulty) law_gate(s, 0, NAN);
    for (i = 0; i < GATE_EVENTS; i++)
        if (gate_event[2 * i] <= sample_time[k] &&
            (k == 0 || gate_event[2 * i] > sample_time[k - 1]))
            law_gate(s, (int)gate_event[2 * i + 1], (real)gate_event[2 * i]);
#endif
    law_step(s, measurements, (real)sample_time[k], commands);
}

int main(void)
{
    static law_state right, wrong;
    real expected[LAW_COMMANDS], commands[LAW_COMMANDS];
    double difference = 0, largest = 0;
    int i, k, round;
    law_reset(&right);
    law_reset(&wrong);
    for (round = 0; round < ROUNDS; round++) /* the last sample again and again */
        for (k = round ? SAMPLES - 1 : 0; k < SAMPLES; k++) {
            step(&right, k, 0, expected);
            step(&wrong, k, round == 0 && k >= FIRST && k < LAST, commands);
            if (!is_finite(&wrong, commands)) {
                printf("sample %d: not finite\n", k);
                return 1;
            }
            for (i = 0; i < LAW_COMMANDS; i++)
                if (commands[i] < lowest[i] || commands[i] > highest[i]) {
                    printf("sample %d: command %d beyond its limits\n", k, i);
                    return 1;
                }
            difference = 0;
            for (i = 0; i < LAW_COMMANDS; i++) {
                if (!(fabs(expected[i]) <= largest)) largest = fabs(expected[i]);
                if (!(fabs(commands[i] - expected[i]) <= difference))
                    difference = fabs(commands[i] - expected[i]);
            }
        }
    printf("%.17g %.17g\n", difference, largest);
    return 0;
}
