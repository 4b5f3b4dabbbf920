/* What a step needs of the path and the rig alone, the same for all lanes: tables.tabulate. */

#pragma once

#include "native_path.h"

/* The nodes of a load from a given one on, as many as fill a register: the state that each feels, the rig's
   answer to its force, and what the forces at all nodes do there. */
static void tabulate_nodes(const Work *w, const Step *step, int slot, int first) {
    const int side = w->side, modes = w->modes, all_modes = w->all_modes;
    const int rows = step->rows, states = w->states, last = NODES - first;
    const int many = last < WIDE ? last : WIDE;
    const double *drift_nodes = w->drift_nodes + (size_t)step->panel * drift_nodes_of(w) + first;
    const double *push_nodes = w->push_nodes + (size_t)step->panel * push_nodes_of(w) + first;
    const double *push_end = w->push + (size_t)step->panel * push_of(w) + first;
    const double *shape = w->shape + (ptrdiff_t)slot * all_modes * PADDED + first;
    const double *feels = w->feels + (ptrdiff_t)slot * states * PADDED + first;
    double *respond = step->respond + slot * NODES + first;
    double *push = step->push + (ptrdiff_t)(slot * NODES + first) * states;
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
    Lanes *felt = w->felt;
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
        for (int q = 0; q < step->loads; q++) {
            const double *under = shape + (ptrdiff_t)(q - slot) * all_modes * PADDED;
            Lanes gains = {0};
            for (int m = 0; m < all_modes; m++) gains += felt[m] * whole(under + m * PADDED);
            store(step->gains + (slot * NODES + c) * rows + q * NODES + first, gains, many);
        }
    }
}

static void tabulate(const Work *w, const Step *step) {
    const int all_modes = w->all_modes, states = w->states, looked = w->looked, padded = filled(looked);
    memcpy(step->seen, w->watch + (size_t)step->panel * watch_of(w), 8 * watch_of(w));
    if (!step->loads) return;
    follow(w, step);
    const double *sights = w->watch_push + (size_t)step->panel * watch_push_of(w);
    for (int s = 0; s < step->loads; s++) {
        const double *shape = w->shape + (ptrdiff_t)s * all_modes * PADDED;
        for (int first = 0; first < NODES; first += WIDE) tabulate_nodes(w, step, s, first);
        for (int f = 0; f < NODES; f++)
            for (int l = 0; l < looked; l += WIDE) {
                const double *sight = sights + f * all_modes * padded + l;
                Lanes seen = {0};
                for (int m = 0; m < all_modes; m++)
                    seen += shape[m * PADDED + f] * whole(sight + m * padded);
                double *kept = step->seen + (ptrdiff_t)(states + s * NODES + f) * looked + l;
                store(kept, seen, looked - l < WIDE ? looked - l : WIDE);
            }
    }
}
