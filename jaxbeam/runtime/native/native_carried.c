/* P carried back over a group of stretches, as flows.carried has it, by hand.

   Lanes are taken in groups that fill a vector register; for each, P stays where it is worked on. Of what
   is symmetric, the entries from the diagonal on are worked out. native_designs.py gives the arguments. */

#include "native_matrices.h"

enum { DRIFT, PUSH, TOLL, EFFORT, TERMINAL, ARGUMENTS };

typedef struct {
    int states, values, both;
    Array in[ARGUMENTS];
    double *out;
} Work;

typedef struct {
    Lanes *cost, *total, *held, *scaled, *spent;
} Room;

/* sums = (drift, push)' right', or added to them, for so many rows at a time from one of them on. */
static int across(Lanes *sums, int width, const Work *w, int64_t s, int row, int rows, Matrix right,
                  int columns, Span span, int add) {
    const int later = row >= w->states, entries = later ? w->values : w->states;
    const int first = later ? row - w->states : row, left = entries - first;
    const int step = taken(rows - row < left ? rows - row : left);
    array_rows(sums, width, w->in + (later ? PUSH : DRIFT), s * w->states * entries + first,
               (Matrix){NULL, 1, entries}, step, right, columns, w->states, span, add);
    return step;
}

/* toll + (drift, push)' P (drift, push), of a stretch. */
static void sum_up(const Work *w, const Room *room, int64_t s, Span span) {
    const int states = w->states, both = w->both;
    for (int j = 0; j < both; j++) { /* and what is left of the diagonal in the same strip of columns */
        const int first = j < 3 ? 0 : j - 3;
        fetch(room->total + j * both + first, w->in + TOLL, (s * both + j) * both + first, both - first,
              span);
    }
    for (int i = 0, step; i < both; i += step) {
        step = across(room->held, states, w, s, i, both, (Matrix){room->cost, states, 1}, states, span, 0);
        Lanes *total = room->total + i;
        for (int j = 0; j < i + step;)
            j += across(total + j * both, both, w, s, j, i + step, (Matrix){room->held, states, 1}, step,
                        span, 1);
    }
}

/* Factors without pivots of what commands cost: L' D L, with the shares L below the diagonal and -1 / D. */
static inline ALWAYS void factor(Lanes *spent, int values) {
    for (int k = 0; k < values; k++) {
        Lanes *row = spent + k * values;
        const Lanes inverse = 1 / row[k];
        for (int a = k + 1; a < values; a++) {
            const Lanes share = row[a] * inverse;
            for (int b = a; b < values; b++) spent[a * values + b] -= share * row[b];
            spent[a * values + k] = share;
        }
        row[k] = -inverse;
    }
}

/* A row of `mixed` by these factors, and the same times -1 / D. */
static inline ALWAYS void part_row(Lanes *mixed, Lanes *scaled, const Lanes *spent, int values) {
#pragma GCC unroll 6
    for (int a = 0; a < values; a++) {
        Lanes sum = mixed[a];
#pragma GCC unroll 6
        for (int k = 0; k < a; k++) sum -= spent[a * values + k] * mixed[k];
        mixed[a] = sum;
        scaled[a] = spent[a * values + a] * sum;
    }
}

/* P at the start: what is left of the total for the states when the best commands are taken, that is
   total_xx - mixed spent^-1 mixed'. */
static void take_best(const Work *w, const Room *room, Span span) {
    const int states = w->states, values = w->values, both = w->both;
    Lanes *mixed = room->total + states, *scaled = room->scaled, *spent = room->spent;
    fetch(spent, w->in + EFFORT, 0, values * values, span);
    for (int a = 0; a < values; a++)
        for (int b = a; b < values; b++) spent[a * values + b] += mixed[(states + a) * both + b];
    if (values == NODES) factor(spent, NODES); /* one command: in registers */
    else factor(spent, values);
    for (int i = 0; i < states; i++)
        if (values == NODES) part_row(mixed + i * both, scaled + i * NODES, spent, NODES);
        else part_row(mixed + i * both, scaled + i * values, spent, values);
    for (int i = 0, step; i < states; i += step) {
        step = taken(states - i);
        few_rows(room->total + i * (both + 1), both, (Matrix){scaled + i * values, values, 1}, step,
                 (Matrix){mixed + i * both, both, 1}, states - i, values);
    }
    for (int i = 0; i < states; i++)
        for (int j = i; j < states; j++)
            room->cost[i * states + j] = room->cost[j * states + i] = room->total[i * both + j];
}

static int64_t lay_out(Room *room, int states, int values, Lanes *memory) {
    const int both = states + values;
    const Room_part parts[] = {{&room->cost, states * states},
                               {&room->total, both * both},
                               {&room->held, 4 * states},
                               {&room->scaled, states * values},
                               {&room->spent, values * values}};
    return divide(parts, sizeof parts / sizeof *parts, memory);
}

/* How many numbers of memory a call needs. */
int64_t carried_room(int states, int values) {
    Room room;
    return lay_out(&room, states, values, NULL);
}

XLA_FFI_Error *carried(XLA_FFI_CallFrame *frame) {
    if (asked(frame)) return NULL;
    Work work, *w = &work;
    int64_t lanes;
    arrays(w->in, frame, ARGUMENTS);
    w->out = result(frame, 0, &lanes);
    w->states = (int)w->in[PUSH].dims[1], w->values = (int)w->in[PUSH].dims[2];
    w->both = w->states + w->values;
    const int square = w->states * w->states;
    Room room;
    lay_out(&room, w->states, w->values, memory(frame, 1));
    for (int64_t first = 0; first < lanes; first += WIDE) {
        const Span span = span_of(first, lanes);
        fetch(room.cost, w->in + TERMINAL, 0, square, span);
        for (int64_t s = w->in[PUSH].dims[0];; s--) {
            for (int i = 0; i < square; i++) keep(w->out, s * square + i, room.cost[i], span);
            if (s == 0) break;
            sum_up(w, &room, s - 1, span);
            take_best(w, &room, span);
        }
    }
    return NULL;
}
