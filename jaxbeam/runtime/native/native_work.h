/* What a call is given, a task at a time, and the memory that it works on.

   The command line tells STEPS (of a chunk), NODES (Gauss nodes a step) and POINTS (looked at in a step).
   Where nodes or points are the last axis it is padded to a multiple of FILL. */

#pragma once

#include <math.h>

#include "native_matrices.h"

enum { PADDED = (NODES + FILL - 1) / FILL * FILL };
enum { FRACTIONS = NODES + 1 }; /* of a step, to which propagators lead: its nodes and its end */
enum { TURNS = 2 };             /* groups of lanes that are worked on in turns */

/* The arguments, each with tasks as the first axis, of which there may be one for all: the rig, the panels of
   its grid, the paths of the loads, the loads themselves, places that are watched, and numbers. */
enum { WANTED, STATE_MATRIX, ENDS, SERIES, EDGES, COUNTS, LENGTHS, ACTIVE, WINDOWS, SINCE, CUBICS,
       INERTIA, WEIGHT, PLACES, GAUSS, LAGRANGE, CURVE, LOOKED, ARGUMENTS };
enum { PEAK, PEAK_TIME, LOWEST, LOST, ROOM, RESULTS };

/* What a step needs of the path. Those of the loads that are on the beam are told by number; the nodes of all
   are its rows. Tables go column by column: (state, row), (row, row), (row, state), and (state and row,
   looked). */
typedef struct {
    int panel, loads, rows;
    double start, span;
    const double *drift;
    int64_t *load;
    double *respond, *gains, *push, *seen;
} Step;

/* Lanes that fill a register, and what they go through. The contact forces of a step follow its state in
   memory. */
typedef struct {
    ptrdiff_t first;
    int many;
    Lanes *state, *after, *matrix;
    Lanes *samples;     /* (step, point, place) */
    Lanes *high, *most; /* (step, place): the largest of these, and what may be between them */
} Group;

typedef struct {
    /* How many there are; modes are those of a block. */
    int panels, blocks, side, modes, segments, terms, pieces, slots, loads, places;
    int states, all_modes, looked, columns;
    ptrdiff_t lanes;
    const double *in[ARGUMENTS];
    double *out[RESULTS];
    /* Of the task. Series of mode shapes with those of their first two derivatives; mode shapes at the places
       that are watched, and the deflections there under a unit force. */
    double *series, *sights, *flexibility;
    /* By panel: propagators with nodes, forces or points as the last axis. */
    double *drift_nodes, *push_nodes, *drift, *push, *watch, *watch_push;
    /* Exponentials of a block, for fractions of steps side by side. */
    double *balance;
    Lanes *matrix, *both, *product, *exponential, *doubled, *phi, *phi_after, *weights;
    /* Of a step: shapes and contact rows at its nodes. */
    double *shape, *feels;
    Lanes *felt, *sums, *powers;
    /* Of the lanes so far: states, and what extremes.py keeps. */
    double *state, *score, *samples, *start, *span, *lowest, *lost, *sound;
    Group groups[TURNS];
    Step steps[STEPS];
    double ends[2 * POINTS]; /* slope of the curve through samples, at both ends */
} Work;

static int filled(int count) { return (count + FILL - 1) / FILL * FILL; }

/* Numbers that a panel takes. */
static size_t drift_nodes_of(const Work *w) { return (size_t)w->states * w->side * PADDED; }
static size_t push_of(const Work *w) { return (size_t)w->states * w->modes * PADDED; }
static size_t push_nodes_of(const Work *w) { return NODES * push_of(w); }
static size_t drift_of(const Work *w) { return (size_t)w->states * w->side; }
static size_t watch_of(const Work *w) { return (size_t)w->states * w->looked; }
static size_t watch_push_of(const Work *w) { return (size_t)NODES * w->all_modes * filled(w->looked); }

/* The next part of the memory; parts begin where registers do. */
static void *part(uintptr_t room, size_t *used, size_t numbers) {
    void *begin = (void *)(room + *used);
    *used += (8 * numbers + sizeof(Lanes) - 1) & -sizeof(Lanes);
    return begin;
}

/* Share out the memory; returns how many bytes it takes. */
static size_t share(Work *w, uintptr_t room) {
    size_t used = 0, lanes = (size_t)w->lanes, panels = (size_t)w->panels, side = (size_t)w->side;
    size_t rows = (size_t)w->slots * NODES, states = (size_t)w->states, looked = (size_t)w->looked;
    size_t places = (size_t)w->places, all_modes = (size_t)w->all_modes, modes = (size_t)w->modes;
    w->series = part(room, &used, (size_t)w->segments * w->terms * w->columns);
    w->sights = part(room, &used, places * all_modes);
    w->flexibility = part(room, &used, places);
    w->drift_nodes = part(room, &used, panels * drift_nodes_of(w));
    w->push_nodes = part(room, &used, panels * push_nodes_of(w));
    w->drift = part(room, &used, panels * drift_of(w));
    w->push = part(room, &used, panels * push_of(w));
    w->watch = part(room, &used, panels * watch_of(w));
    w->watch_push = part(room, &used, panels * watch_push_of(w));
    w->balance = part(room, &used, side);
    w->matrix = part(room, &used, side * side * WIDE);
    w->both = part(room, &used, side * (side + modes) * WIDE);
    w->product = part(room, &used, side * (side + NODES * modes) * WIDE);
    w->exponential = part(room, &used, side * side * WIDE);
    w->doubled = part(room, &used, side * side * WIDE);
    w->phi = part(room, &used, side * NODES * modes * WIDE);
    w->phi_after = part(room, &used, side * NODES * modes * WIDE);
    w->weights = part(room, &used, NODES * NODES * WIDE);
    w->shape = part(room, &used, (size_t)w->slots * all_modes * PADDED);
    w->feels = part(room, &used, (size_t)w->slots * states * PADDED);
    w->felt = part(room, &used, all_modes * WIDE);
    w->sums = part(room, &used, (size_t)2 * w->columns * WIDE);
    w->powers = part(room, &used, (size_t)w->terms * WIDE);
    w->state = part(room, &used, states * lanes);
    w->score = part(room, &used, places * lanes);
    w->samples = part(room, &used, POINTS * places * lanes);
    w->start = part(room, &used, places * lanes);
    w->span = part(room, &used, places * lanes);
    w->lowest = part(room, &used, (size_t)w->loads * lanes);
    w->lost = part(room, &used, (size_t)w->loads * lanes);
    w->sound = part(room, &used, lanes);
    for (int k = 0; k < TURNS; k++) {
        Group *g = w->groups + k;
        g->state = part(room, &used, (states + rows) * WIDE);
        g->after = part(room, &used, (states + rows) * WIDE);
        g->matrix = part(room, &used, rows * rows * WIDE);
        g->samples = part(room, &used, STEPS * looked * WIDE);
        g->high = part(room, &used, STEPS * places * WIDE);
        g->most = part(room, &used, STEPS * places * WIDE);
    }
    for (int t = 0; t < STEPS; t++) {
        Step *step = w->steps + t;
        step->load = part(room, &used, (size_t)w->slots);
        step->respond = part(room, &used, rows * states);
        step->gains = part(room, &used, rows * rows);
        step->push = part(room, &used, rows * states);
        step->seen = part(room, &used, (states + rows) * looked);
    }
    return used;
}

/* Sizes that follow from others. */
static void complete(Work *w) {
    w->states = w->blocks * w->side, w->all_modes = w->blocks * w->modes;
    w->looked = POINTS * w->places, w->columns = 3 * w->all_modes;
}

/* The arguments of a task. */
static void give(Work *w, const XLA_FFI_CallFrame *frame, int64_t task) {
    for (int i = 0; i < ARGUMENTS; i++) {
        const XLA_FFI_Buffer *buffer = frame->args.args[i];
        int64_t bytes = i == WANTED || i == ACTIVE ? 1 : 8;
        for (int64_t d = 1; d < buffer->rank; d++) bytes *= buffer->dims[d];
        int64_t away = buffer->dims[0] > 1 ? task * bytes : 0;
        w->in[i] = (const double *)((const char *)buffer->data + away);
    }
}

static int64_t steps_of(const Work *w, int panel) { return ((const int64_t *)w->in[COUNTS])[panel]; }
