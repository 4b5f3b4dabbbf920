/* Lanes go through the steps of a chunk: what advance.advance and extremes.fold do, without a driver. */

#pragma once

#include "native_exponentials.h"
#include "native_peaks.h"
#include "native_tables.h"

/* How little the loads have pressed so far, and when they first would have had to pull. */
static void press(const Work *w, const Step *step, const Group *g) {
    for (int s = 0; s < step->loads; s++) {
        const Lanes *forces = g->state + w->states + s * NODES;
        const ptrdiff_t at = step->load[s] * w->lanes + g->first;
        Lanes pull = forces[0];
        for (int k = 1; k < NODES; k++) pull = greater(forces[k], pull);
        store(w->lowest + at, less(-pull, load(w->lowest + at, g->many)), g->many);
        if (!any(pull > 0)) continue;
        Lanes when = load(w->lost + at, g->many);
        for (int k = 0; k < NODES; k++) {
            Lanes time = all(step->start + step->span * w->in[GAUSS][k]);
            when = either(forces[k] > 0, less(time, when), when);
        }
        store(w->lost + at, when, g->many);
    }
}

/* The contact forces at the nodes of a step. */
static inline ALWAYS void meet(const Work *w, const Step *step, const Group *g, int loads, Lanes *matrix,
                               Lanes *forces) {
    const int rows = loads * NODES;
    memset(forces, 0, (size_t)rows * sizeof *forces);
    add_product(forces, step->respond, rows, g->state, w->states);
    for (int s = 0; s < loads; s++) {
        const ptrdiff_t at = step->load[s] * w->lanes + g->first;
        Lanes mass = load(w->in[INERTIA] + at, g->many), weight = load(w->in[WEIGHT] + at, g->many);
        for (int i = s * NODES; i < (s + 1) * NODES; i++) {
            forces[i] = -(weight + mass * forces[i]);
            for (int j = 0; j < rows; j++) matrix[i * rows + j] = mass * step->gains[i * rows + j];
            matrix[i * rows + i] += 1;
        }
    }
    eliminate(matrix, forces, rows);
}

static void collocate(const Work *w, const Step *step, const Group *g) {
    if (step->loads == 1) { /* in registers */
        Lanes matrix[NODES * NODES], forces[NODES];
        meet(w, step, g, 1, matrix, forces);
        memcpy(g->state + w->states, forces, sizeof forces);
    } else {
        meet(w, step, g, step->loads, g->matrix, g->state + w->states);
    }
}

/* Deflections at the points of a step, and the largest of them. */
static void watch(const Work *w, int t, const Step *step, const Group *g) {
    Lanes *seen = g->samples + t * w->looked;
    memset(seen, 0, (size_t)w->looked * sizeof *seen);
    add_product(seen, step->seen, w->looked, g->state, w->states + step->rows);
    for (int place = 0; place < w->places; place++) {
        Lanes high = {0};
        for (int i = place; i < w->looked; i += w->places) high = greater(absolute(seen[i]), high);
        g->high[t * w->places + place] = high;
        g->most[t * w->places + place] = most_within(seen[place], seen[w->looked - w->places + place], high);
    }
}

/* The state at the end of a step; without forces, modes that are not coupled are two states each. */
static void move(const Work *w, const Step *step, Group *g) {
    const double *drift = step->drift;
    Lanes *state = g->state, *after = g->after;
    if (w->side == 2) {
        for (int i = 0; i < w->states; i += 2, drift += 4) {
            after[i] = drift[0] * state[i] + drift[2] * state[i + 1];
            after[i + 1] = drift[1] * state[i] + drift[3] * state[i + 1];
        }
    } else {
        memset(after, 0, (size_t)w->states * sizeof *after);
        for (int i = 0; i < w->states; i += w->side, drift += w->side * w->side)
            add_product(after + i, drift, w->side, state + i, w->side);
    }
    if (step->loads) add_product(after, step->push, w->states, state + w->states, step->rows);
    g->state = after, g->after = state;
}

/* The peaks so far, from the samples of all steps. */
static void raise(const Work *w, int count, const Group *g, int place) {
    const int many = g->many;
    const ptrdiff_t at = place * w->lanes + g->first, plane = w->places * w->lanes;
    const Lanes *seen = g->samples + place;
    Lanes before = load(w->score + at, many), least = before, score = before, top = {0};
    for (int t = 0; t < count; t++) least = greater(g->high[t * w->places + place], least);
    for (int t = 0; t < count; t++) {
        /* Only steps that may come above the highest of all samples can have the peak. */
        Lanes found = g->high[t * w->places + place];
        Mask maybe = g->most[t * w->places + place] > least;
        if (!any(maybe)) continue;
        Lanes samples[POINTS];
        for (int p = 0; p < POINTS; p++) samples[p] = seen[(t * POINTS + p) * w->places];
        if (any(maybe & rises_within(samples, w->ends, found)))
            found = vertex(samples, w->in[CURVE], w->in[LOOKED]);
        top = either(found > score, all(t), top);
        score = greater(found, score);
    }
    Mask better = score > before;
    if (!any(better)) return;
    store(w->score + at, score, many);
    for (int t = 0; t < count; t++) {
        Mask here = better & (top == all(t));
        if (!any(here)) continue;
        for (int p = 0; p < POINTS; p++) {
            double *kept = w->samples + p * plane + at;
            store(kept, either(here, seen[(t * POINTS + p) * w->places], load(kept, many)), many);
        }
        const Step *step = w->steps + t;
        store(w->start + at, either(here, all(step->start), load(w->start + at, many)), many);
        store(w->span + at, either(here, all(step->span), load(w->span + at, many)), many);
    }
}

/* All steps of the chunk for a few groups of lanes, in turns: while one waits for its divisions, others
   have work. */
static void take(const Work *w, int count, Group *groups, int turns) {
    Group *end = groups + turns;
    for (const Group *g = groups; g < end; g++)
        for (int i = 0; i < w->states; i++)
            g->state[i] = load(w->state + i * w->lanes + g->first, g->many);
    for (int t = 0; t < count; t++) {
        const Step *step = w->steps + t;
        if (step->loads) {
            for (const Group *g = groups; g < end; g++) collocate(w, step, g);
            for (const Group *g = groups; g < end; g++) press(w, step, g);
        }
        for (const Group *g = groups; g < end; g++) watch(w, t, step, g);
        for (Group *g = groups; g < end; g++) move(w, step, g);
    }
    for (const Group *g = groups; g < end; g++) {
        for (int place = 0; place < w->places; place++) raise(w, count, g, place);
        Lanes nothing = {0}; /* unless a state is infinite or not a number, as it then stays */
        for (int i = 0; i < w->states; i++) {
            store(w->state + i * w->lanes + g->first, g->state[i], g->many);
            nothing += 0 * g->state[i];
        }
        double *sound = w->sound + g->first;
        store(sound, either(nothing == 0, load(sound, g->many), all(0)), g->many);
    }
}

/* Whether the energy left cannot raise any peak: static deflection bounds the dynamic one. Runs that have
   blown up have nothing more to show. */
static int spent(const Work *w) {
    const int side = w->side, modes = w->modes;
    for (ptrdiff_t first = 0; first < w->lanes; first += WIDE) {
        const int many = w->lanes - first < WIDE ? (int)(w->lanes - first) : WIDE;
        Lanes energy = {0};
        for (int b = 0; b < w->blocks; b++) {
            const double *state = w->state + b * side * w->lanes + first;
            const double *matrix = w->in[STATE_MATRIX] + b * side * side;
            for (int i = 0; i < 2 * modes; i += 2) {
                Lanes rate = load(state + (i + 1) * w->lanes, many), pull = {0};
                for (int j = 0; j < 2 * modes; j += 2)
                    pull -= matrix[(i + 1) * side + j] * load(state + j * w->lanes, many);
                energy += rate * rate + load(state + i * w->lanes, many) * pull;
            }
        }
        const Mask finite = 0 * energy == 0;
        for (int place = 0; place < w->places; place++) {
            Lanes score = load(w->score + place * w->lanes + first, many);
            Mask above = finite & ~(w->flexibility[place] * energy < score * score);
            for (int l = 0; l < many; l++)
                if (above[l]) return 0;
        }
    }
    return 1;
}
