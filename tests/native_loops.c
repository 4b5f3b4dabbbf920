/* Events of a translated loop: reads the arguments of each, writes the commands that it finds. */

#include <stdio.h>
#include <stdlib.h>

#include "registers.h"

void process_event(const void *const *inputs, int64_t event, double time, Register *memory,
                   const Register *state, Register *commands);

static FILE *file;

static int64_t next_count(void) {
    int64_t count;
    if (fread(&count, 8, 1, file) != 1) exit(2);
    return count;
}

static void *next_numbers(int64_t count, int64_t lanes) {
    const size_t bytes = 8 * (size_t)(count * lanes);
    double *numbers = aligned_alloc(64, (bytes + 64) / 64 * 64), number;
    for (int64_t i = 0; i < count; i++) {
        if (fread(&number, 8, 1, file) != 1) exit(3);
        for (int64_t l = 0; l < lanes; l++) numbers[i * lanes + l] = number;
    }
    return numbers;
}

int main(int count, char **names) {
    file = fopen(names[1], "rb");
    if (count != 2 || !file) return 1;
    const int64_t inputs = next_count();
    void **given = malloc(8 * (size_t)inputs);
    for (int64_t i = 0; i < inputs; i++) given[i] = next_numbers(next_count(), 1);
    Register *memory = next_numbers(next_count(), REGISTER_WIDTH);
    const int64_t events = next_count(), states = next_count(), actuators = next_count();
    Register *commands = aligned_alloc(64, (size_t)actuators * 64);
    for (int64_t event = 0; event < events; event++) {
        double *time = next_numbers(1, 1);
        Register *state = next_numbers(states, REGISTER_WIDTH);
        for (int64_t i = 0; i < states; i++) /* runs that differ: the last at rest */
            for (int l = 0; l < REGISTER_WIDTH; l++) state[i][l] *= 1 - l / (REGISTER_WIDTH - 1.0);
        process_event((const void *const *)given, event, *time, memory, state, commands);
        for (int64_t a = 0; a < actuators; a++)
            printf("%.17g %.17g ", commands[a][0], commands[a][REGISTER_WIDTH - 1]);
        printf("\n");
        free(time);
        free(state);
    }
    for (int64_t i = 0; i < inputs; i++) free(given[i]);
    free(given);
    free(memory);
    free(commands);
    fclose(file);
    return 0;
}
