/* What a chunk of steps needs of the path and the rig alone, the same for all lanes: tables.tabulate.

   The command line tells STEPS (of a chunk), NODES (Gauss nodes a step) and POINTS. Where nodes or points are
   the last axis it is padded to a multiple of FILL. */

#pragma once

#include "native_lanes.h"

enum { PADDED = (NODES + FILL - 1) / FILL * FILL };

/* The arguments: propagators by kind of step, the path, loads, numbers, and what changes. */
enum { DRIFT_NODES, PUSH_NODES, DRIFT, PUSH, WATCH, WATCH_PUSH, KIND, START, SPAN, SLOTS, ACTIVE,
       SHAPE, ROWS, INERTIA, WEIGHT, GAUSS, CURVE, LOOKED,
       STATE, SCORE, SAMPLES, BEST_START, BEST_SPAN, LOWEST, LOST, SOUND, ARGUMENTS };
enum { KEPT = ARGUMENTS - STATE };

typedef struct {
    int rows, states, blocks, side, modes, slots, places, looked; /* modes of a block */
    int64_t lanes;
    const double *in[ARGUMENTS];
    const int64_t *kind, *slot;
    const uint8_t *active, *sound_in;
    double *out[KEPT];
    uint8_t *sound;
    double ends[2 * POINTS]; /* slope of the curve through samples, at both ends */
} Work;

/* What a step needs of the path. Of no use without a load on the beam, but for drift and watch. */
typedef struct {
    int taken, pressed;
    const double *drift;
    double *respond, *gains, *push; /* (state, row), (row, row), (row, state) */
    double *seen;                   /* (state and row, looked) */
} Step;

static int loaded(const Work *w, int t) {
    int pressed = 0;
    for (int s = 0; s < w->slots; s++) pressed |= w->active[t * w->slots + s];
    return pressed;
}

/* Numbers that the tables of a step take. */
static size_t tables_of(const Work *w) {
    return (size_t)w->rows * (size_t)(2 * w->states + w->rows) + (size_t)w->looked * (size_t)(w->states + w->rows);
}

/* The nodes from a given one on, as many as fill a register, of one load: the state that each feels, the
   rig's answer to its force, and what the forces at all nodes do there. Nodes are the last axis. */
static void tabulate_nodes(const Work *w, const Step *step, ptrdiff_t kind, ptrdiff_t load_of, int p,
                           int first, Lanes *felt) {
    const int side = w->side, modes = w->modes, all_modes = w->blocks * modes;
    const int rows = w->rows, states = w->states, last = NODES - first;
    const int many = last < WIDE ? last : WIDE;
    const double *drift_nodes = w->in[DRIFT_NODES] + kind * states * side * PADDED + first;
    const double *push_nodes = w->in[PUSH_NODES] + kind * NODES * states * modes * PADDED + first;
    const double *push_end = w->in[PUSH] + kind * states * modes * PADDED + first;
    const double *shape = w->in[SHAPE] + load_of * all_modes * PADDED + first;
    const double *feels = w->in[ROWS] + load_of * states * PADDED + first;
    double *respond = step->respond + p * NODES + first;
    double *push = step->push + (p * NODES + first) * states;
    for (int i = 0; i < states; i++) {
        const double *rows_of = feels + i / side * side * PADDED;
        const double *drifts = drift_nodes + i / side * side * side * PADDED + i % side * PADDED;
        Lanes responds = {0}, pushes = {0};
        for (int j = 0; j < side; j++)
            responds += whole(rows_of + j * PADDED) * whole(drifts + j * side * PADDED);
        for (int m = 0; m < modes; m++)
            pushes += whole(shape + (i / side * modes + m) * PADDED) *
                      whole(push_end + (i * modes + m) * PADDED);
        store(respond + i * rows, responds, many);
        for (int k = 0; k < many; k++) push[k * states + i] = pushes[k];
    }
    for (int c = 0; c < NODES; c++) {
        const double *there = shape - first + c, *feels_there = feels - first + c;
        Lanes here = {0}; /* the force itself bends the beam under it, at once */
        if (c >= first && c < first + WIDE) here[c - first] = 1;
        for (int m = 0; m < all_modes; m++) {
            const int from = m / modes * side;
            const double *pushes = push_nodes + (c * states * modes + m % modes) * PADDED;
            Lanes sum = here * there[m * PADDED];
            for (int i = from; i < from + side; i++)
                sum += feels_there[i * PADDED] * whole(pushes + i * modes * PADDED);
            felt[m] = sum;
        }
        for (int q = 0; q < w->slots; q++) {
            const double *under = shape + (q - p) * all_modes * PADDED;
            Lanes gains = {0};
            for (int m = 0; m < all_modes; m++) gains += felt[m] * whole(under + m * PADDED);
            store(step->gains + (p * NODES + c) * rows + q * NODES + first, gains, many);
        }
    }
}

static void tabulate(const Work *w, int t, Step *step, Lanes *felt, double *room) {
    const int all_modes = w->blocks * w->modes, rows = w->rows, states = w->states;
    const int looked = w->looked, filled = (looked + FILL - 1) / FILL * FILL;
    const ptrdiff_t kind = (ptrdiff_t)w->kind[t];
    step->taken = w->in[SPAN][t] != 0; /* steps of no length fill up a chunk */
    step->pressed = step->taken && loaded(w, t);
    step->drift = w->in[DRIFT] + kind * states * w->side;
    step->respond = room;
    step->gains = step->respond + rows * states;
    step->push = step->gains + rows * rows;
    step->seen = step->push + rows * states;
    memcpy(step->seen, w->in[WATCH] + kind * looked * states, 8 * (size_t)(states * looked));
    if (!step->pressed) return;
    const double *sights = w->in[WATCH_PUSH] + kind * NODES * all_modes * filled;
    for (int p = 0; p < w->slots; p++) {
        const ptrdiff_t load_of = (ptrdiff_t)t * w->slots + p;
        const double *shape = w->in[SHAPE] + load_of * all_modes * PADDED;
        for (int first = 0; first < NODES; first += WIDE)
            tabulate_nodes(w, step, kind, load_of, p, first, felt);
        for (int f = 0; f < NODES; f++)
            for (int l = 0; l < looked; l += WIDE) {
                const double *sight = sights + f * all_modes * filled + l;
                Lanes seen = {0};
                for (int m = 0; m < all_modes; m++)
                    seen += shape[m * PADDED + f] * whole(sight + m * filled);
                double *kept = step->seen + (states + p * NODES + f) * looked + l;
                store(kept, seen, looked - l < WIDE ? looked - l : WIDE);
            }
    }
}

