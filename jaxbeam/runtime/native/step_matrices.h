/* Step matrices of a task, shared by all its runs: integrator/step_matrices.py, `step_matrices`. */

#pragma once

#include "load_path.h"

/* Rows of one load for its Gauss nodes from `first` on, as many as a register holds: contact
 * response and compliance of a motion. */
static void contact_at_nodes(const Workspace *w, const Step *step, int s, int first, int motion) {
    const int block_size = w->block_size, modes = w->modes, all_modes = w->all_modes;
    const int rows = step->rows, states = w->states, last = NODES - first;
    const int count = last < REGISTER_WIDTH ? last : REGISTER_WIDTH;
    const double *node_transition =
        w->node_transition + (size_t)step->kind * node_transition_size(w) + first;
    const double *node_force_response =
        w->node_force_response + (size_t)step->kind * node_force_response_size(w) + first;
    const double *shape = w->shape + (ptrdiff_t)s * all_modes * PADDED_NODES + first;
    const double *contact_rows =
        motion_rows(w, motion) + (ptrdiff_t)s * states * PADDED_NODES + first;
    double *contact_response = step->contact_response[motion] + s * NODES + first;
    for (int i = 0; i < states; i++) {
        const double *rows_of = contact_rows + i / block_size * block_size * PADDED_NODES;
        const double *transitions = node_transition +
                                    i / block_size * block_size * block_size * PADDED_NODES +
                                    i % block_size * PADDED_NODES;
        Register response = {0};
        for (int j = 0; j < block_size; j++)
            response += load_full(rows_of + j * PADDED_NODES) *
                        load_full(transitions + j * block_size * PADDED_NODES);
        store(contact_response + i * rows, response, count);
    }
    Register *acceleration = w->acceleration;
    for (int c = 0; c < NODES; c++) {
        const double *there = shape - first + c, *contact_rows_there = contact_rows - first + c;
        Register here = {0}; /* direct term: the force accelerates the beam under the load */
        if (motion == ACCELERATION && c >= first && c < first + REGISTER_WIDTH) here[c - first] = 1;
        for (int m = 0; m < all_modes; m++) {
            const int from = m / modes * block_size;
            const double *response_of_force =
                node_force_response + (c * states * modes + m % modes) * PADDED_NODES;
            Register sum = here * there[m * PADDED_NODES];
            for (int i = from; i < from + block_size; i++)
                sum += contact_rows_there[i * PADDED_NODES] *
                       load_full(response_of_force + i * modes * PADDED_NODES);
            acceleration[m] = sum;
        }
        for (int q = 0; q < step->loads; q++) {
            const double *under = shape + (ptrdiff_t)(q - s) * all_modes * PADDED_NODES;
            Register contact_compliance = {0};
            for (int m = 0; m < all_modes; m++)
                contact_compliance += acceleration[m] * load_full(under + m * PADDED_NODES);
            store(step->contact_compliance[motion] + (s * NODES + c) * rows + q * NODES + first,
                  contact_compliance, count);
        }
    }
}

/* Force response of one load for its Gauss nodes from `first` on, as many as a register holds. */
static void force_response_at_nodes(const Workspace *w, const Step *step, int s, int first) {
    const int modes = w->modes, states = w->states, last = NODES - first;
    const int count = last < REGISTER_WIDTH ? last : REGISTER_WIDTH;
    const double *shape = w->shape + (ptrdiff_t)s * w->all_modes * PADDED_NODES + first;
    const double *end_response =
        w->force_response + (size_t)step->kind * force_response_size(w) + first;
    double *force_response = step->force_response + (ptrdiff_t)(s * NODES + first) * states;
    for (int i = 0; i < states; i++) {
        Register response = {0};
        for (int m = 0; m < modes; m++)
            response += load_full(shape + (i / w->block_size * modes + m) * PADDED_NODES) *
                        load_full(end_response + (i * modes + m) * PADDED_NODES);
        for (int k = 0; k < count; k++) force_response[k * states + i] = response[k];
    }
}

/* Contact at the ends of a step, each of which is a node of the load path: peaks/end_forces.py. */
static void contact_at_ends(const Workspace *w, const Step *step) {
    const int loads = step->loads, all_modes = w->all_modes;
    for (int end = 0; end < 2; end++)
        for (int s = 0; s < loads; s++) {
            const int at = NODES + end;
            const double *rows =
                motion_rows(w, ACCELERATION) + (ptrdiff_t)s * w->states * PADDED_NODES + at;
            const double *shape = w->shape + (ptrdiff_t)s * all_modes * PADDED_NODES + at;
            for (int i = 0; i < w->states; i++)
                step->end_response[(end * w->states + i) * loads + s] = rows[i * PADDED_NODES];
            for (int q = 0; q < loads; q++) {
                const double *other = w->shape + (ptrdiff_t)q * all_modes * PADDED_NODES + at;
                double sum = 0;
                for (int m = 0; m < all_modes; m++)
                    sum += shape[m * PADDED_NODES] * other[m * PADDED_NODES];
                step->end_compliance[(end * loads + s) * loads + q] = sum;
            }
        }
}

/* Matrices of a step with its loads. */
static void step_matrices(const Workspace *w, const Step *step) {
    const int all_modes = w->all_modes, states = w->states;
    const int sample_count = w->sample_count, padded = padded_size(sample_count);
    memcpy(step->sample_rows, w->sample_rows + (size_t)step->kind * sample_rows_size(w),
           8 * sample_rows_size(w));
    if (!step->loads) return;
    load_path(w, step);
    const double *sample_response =
        w->sample_response + (size_t)step->kind * sample_response_size(w);
    for (int s = 0; s < step->loads; s++) {
        const double *shape = w->shape + (ptrdiff_t)s * all_modes * PADDED_NODES;
        for (int first = 0; first < NODES; first += REGISTER_WIDTH) {
            force_response_at_nodes(w, step, s, first);
            for (int motion = 0; s >= step->prescribed && motion < w->motions; motion++)
                contact_at_nodes(w, step, s, first, motion);
        }
        for (int f = 0; f < NODES; f++)
            for (int l = 0; l < sample_count; l += REGISTER_WIDTH) {
                const double *input_row = sample_response + f * all_modes * padded + l;
                Register sampled = {0};
                for (int m = 0; m < all_modes; m++)
                    sampled += shape[m * PADDED_NODES + f] * load_full(input_row + m * padded);
                double *stored =
                    step->sample_rows + (ptrdiff_t)(states + s * NODES + f) * sample_count + l;
                store(stored, sampled,
                      sample_count - l < REGISTER_WIDTH ? sample_count - l : REGISTER_WIDTH);
            }
    }
    if (!step->ends) return;
    contact_at_ends(w, step);
    memset(step->sample_rows + (ptrdiff_t)(states + step->rows) * sample_count, 0,
           8 * (size_t)step->ends * sample_count);
    for (int s = 0; s < step->loads; s++) add_influence(w, step, s);
}
