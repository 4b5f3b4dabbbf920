/* P carried back over a group of stretches, as flows.carried has it, by hand.

   Lanes are taken in groups that fill a vector register; for each, P and what a stretch does stay where
   they are worked on. Of what is symmetric half is worked out. native_designs.py gives the arguments. */

#include "native_matrices.h"

enum { ACROSS, TOLL, EFFORT, TERMINAL, ARGUMENTS };

typedef struct {
    Lanes *cost, *across, *total, *held, *mixed, *scaled, *spent;
} Room;

/* What is left of `total`, lower half, for the states, when the best commands, its last rows, are taken:
   total_xx - mixed' spent^-1 mixed, by factors without pivots. */
static void take_best(Lanes *cost, const Room *room, int states, int values) {
    const int both = states + values;
    Lanes *mixed = room->mixed, *scaled = room->scaled, *spent = room->spent;
    for (int a = 0; a < values; a++) {
        const Lanes *row = room->total + (states + a) * both;
        for (int i = 0; i < states; i++) mixed[i * values + a] = row[i];
        for (int b = 0; b <= a; b++) spent[a * values + b] += row[states + b];
    }
    for (int k = 0; k < values; k++) {
        const Lanes inverse = 1 / spent[k * values + k];
        for (int a = k + 1; a < values; a++) {
            const Lanes share = spent[a * values + k] * inverse;
            for (int b = k + 1; b <= a; b++) spent[a * values + b] -= share * spent[b * values + k];
            for (int i = 0; i < states; i++) mixed[i * values + a] -= share * mixed[i * values + k];
        }
        for (int i = 0; i < states; i++) scaled[i * values + k] = -inverse * mixed[i * values + k];
    }
    for (int i = 0, step; i < states; i += step) {
        step = taken(states - i);
        few_rows(room->total + i * both, both, (Matrix){scaled + i * values, values, 1}, step,
                 (Matrix){mixed, values, 1}, i + step, values);
    }
    for (int i = 0; i < states; i++)
        for (int j = 0; j <= i; j++)
            cost[i * states + j] = cost[j * states + i] = room->total[i * both + j];
}

static void carry(const Array *in, double *out, int states, int both, Span span, const Room *room) {
    const int values = both - states, square = states * states;
    fetch(room->cost, in + TERMINAL, 0, square, span);
    for (int64_t s = in[ACROSS].dims[0] - 1; s >= 0; s--) {
        fetch(room->across, in + ACROSS, s * both * states, both * states, span);
        fetch(room->spent, in + EFFORT, 0, values * values, span);
        for (int i = 0, step; i < both; i += step) {
            step = taken(both - i);
            Lanes *total = room->total + i * both;
            const Matrix row = {room->across + i * states, states, 1}, held = {room->held, states, 1};
            for (int k = 0; k < step; k++)
                fetch(total + k * both, in + TOLL, (s * both + i + k) * both, i + step, span);
            memset(room->held, 0, (size_t)(step * states) * sizeof(Lanes));
            few_rows(room->held, states, row, step, (Matrix){room->cost, states, 1}, states, states);
            few_rows(total, both, held, step, (Matrix){room->across, states, 1}, i + step, states);
        }
        take_best(room->cost, room, states, values);
        for (int i = 0; i < square; i++) keep(out, s * square + i, room->cost[i], span);
    }
}

XLA_FFI_Error *carried(XLA_FFI_CallFrame *frame) {
    if (asked(frame)) return NULL;
    Array in[ARGUMENTS];
    arrays(in, frame, ARGUMENTS);
    int64_t lanes;
    double *out = result(frame, 0, &lanes);
    const int both = (int)in[ACROSS].dims[1], states = (int)in[ACROSS].dims[2];
    const int values = both - states, square = states * states;
    Room room;
    const Room_part parts[] = {{&room.cost, square},
                               {&room.across, both * states},
                               {&room.total, both * both},
                               {&room.held, 4 * states},
                               {&room.mixed, states * values},
                               {&room.scaled, states * values},
                               {&room.spent, values * values}};
    Lanes *all_room = divided(parts, sizeof parts / sizeof *parts, 0);
    if (!all_room) return fault(frame, "not enough memory for jaxbeam's designs");
    for (int64_t first = 0; first < lanes; first += WIDE)
        carry(in, out, states, both, span_of(first, lanes), &room);
    free(all_room);
    return NULL;
}
