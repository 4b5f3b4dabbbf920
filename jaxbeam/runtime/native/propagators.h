/* Propagators of all step lengths: integrator/discrete_model.py, `propagators`. TAYLOR_TERMS and DOUBLINGS
 * are macros. */

#pragma once

#include "matrices.h"
#include "workspace.h"

/* Fractions of the steps of all lengths, as many as a register holds, and how long they are (s). */
typedef struct {
    int count, kind[REGISTER_WIDTH], fraction[REGISTER_WIDTH];
    Register length;
} Fractions;

/* Next fractions; lengths that no step has are skipped. */
static Fractions next_fractions(const Workspace *w, int *kind, int *fraction) {
    Fractions f = {0};
    while (f.count < REGISTER_WIDTH && *kind < w->lengths) {
        if (*fraction == STEP_FRACTIONS || !w->length_used[*kind]) {
            ++*kind, *fraction = 0;
            continue;
        }
        const double fraction_of_step = *fraction < NODES ? w->inputs[GAUSS_NODES][*fraction] : 1;
        f.length[f.count] = w->inputs[STEP_LENGTHS][*kind] * fraction_of_step;
        f.kind[f.count] = *kind, f.fraction[f.count++] = (*fraction)++;
    }
    return f;
}

/* to = left right */
static void multiply(Register *to, const Register *left, int rows, int terms, const Register *right,
                     int columns) {
    memset(to, 0, (size_t)rows * (size_t)columns * sizeof *to);
    add_matrix_product(to, left, rows, right, terms, columns);
}

/* Scale of the states that makes deflections and rates of modes comparable. */
static void balance_states(const Workspace *w, const double *matrix) {
    for (int i = 0; i < w->block_size; i++) {
        const int is_deflection = i % 2 == 0 && i < 2 * w->modes;
        w->scale[i] = is_deflection ? sqrt(1 + fabs(matrix[(i + 1) * w->block_size + i])) : 1;
    }
}

static const double INVERSE_FACTORIAL[] = {1, 1, 1 / 2., 1 / 6., 1 / 24., 1 / 120., 1 / 720.};
_Static_assert(NODES < sizeof INVERSE_FACTORIAL / sizeof(double), "factorials for all nodes");

/* Exponential (state, state) of `block_matrix`, doubled so often, and its phi functions times the
 * `input_matrix` (state, phi function and input): Taylor series, doubled. */
static void exponential_and_phi(Workspace *w, int block_size, int modes) {
    const int width = block_size + modes, columns = NODES * modes;
    /* (state, state and input): identity and input matrix, then partial sums */
    Register *sums = w->series_sums, *product = w->product;
    memset(sums, 0, (size_t)(block_size * width) * sizeof *sums);
    for (int i = 0; i < block_size; i++) {
        sums[i * width + i] = broadcast(1);
        memcpy(sums + i * width + block_size, w->input_matrix + i * modes,
               (size_t)modes * sizeof *sums);
    }
    for (int term = TAYLOR_TERMS; term > 0; term--) {
        multiply(product, w->block_matrix, block_size, block_size, sums, width);
        for (int i = 0; i < block_size; i++) {
            for (int j = 0; j < block_size; j++)
                sums[i * width + j] = product[i * width + j] / term + (i == j);
            for (int m = 0; m < modes; m++)
                sums[i * width + block_size + m] =
                    product[i * width + block_size + m] / (term + NODES) +
                    w->input_matrix[i * modes + m];
        }
    }
    for (int i = 0; i < block_size; i++) {
        memcpy(w->exponential + i * block_size, sums + i * width,
               (size_t)block_size * sizeof *sums);
        for (int m = 0; m < modes; m++)
            w->phi[i * columns + (NODES - 1) * modes + m] =
                sums[i * width + block_size + m] * INVERSE_FACTORIAL[NODES];
    }
    for (int p = NODES - 1; p > 0; p--) {
        for (int i = 0; i < block_size; i++)
            for (int m = 0; m < modes; m++) {
                Register sum = w->input_matrix[i * modes + m] * INVERSE_FACTORIAL[p];
                for (int k = 0; k < block_size; k++)
                    sum +=
                        w->block_matrix[i * block_size + k] * w->phi[k * columns + p * modes + m];
                w->phi[i * columns + (p - 1) * modes + m] = sum;
            }
    }
    for (int d = 0; d < DOUBLINGS; d++) {
        multiply(w->doubled_phi, w->exponential, block_size, block_size, w->phi, columns);
        for (int p = 0; p < NODES; p++)
            for (int i = 0; i < block_size; i++) {
                Register *after = w->doubled_phi + i * columns + p * modes;
                for (int q = 0; q <= p; q++)
                    for (int m = 0; m < modes; m++)
                        after[m] += w->phi[i * columns + q * modes + m] * INVERSE_FACTORIAL[p - q];
                for (int m = 0; m < modes; m++) after[m] /= 2 << p;
            }
        multiply(w->doubled_exponential, w->exponential, block_size, block_size, w->exponential,
                 block_size);
        Register *spare = w->phi;
        w->phi = w->doubled_phi, w->doubled_phi = spare;
        spare = w->exponential, w->exponential = w->doubled_exponential,
        w->doubled_exponential = spare;
    }
}

/* Exponential of a block over a length, and its phi functions times the inputs (state, phi function
 * and mode). */
static void block_exponential(Workspace *w, const double *matrix, Register length) {
    const int block_size = w->block_size, modes = w->modes;
    for (int i = 0; i < block_size; i++)
        for (int j = 0; j < block_size; j++)
            w->block_matrix[i * block_size + j] =
                length *
                (matrix[i * block_size + j] * w->scale[i] / w->scale[j] / (1 << DOUBLINGS));
    memset(w->input_matrix, 0, (size_t)(block_size * modes) * sizeof *w->input_matrix);
    for (int m = 0; m < modes; m++) w->input_matrix[(2 * m + 1) * modes + m] = broadcast(1);
    exponential_and_phi(w, block_size, modes);
}

/* Transition and force response of a block from its exponential and phi functions; contact forces
 * are the polynomials through their values at the Gauss nodes. */
static void store_propagators(Workspace *w, int block, const Fractions *f) {
    const int block_size = w->block_size, modes = w->modes, columns = NODES * modes;
    for (int i = 0; i < block_size; i++)
        for (int j = 0; j < block_size; j++) {
            const Register transition =
                w->exponential[i * block_size + j] * (w->scale[j] / w->scale[i]);
            for (int l = 0; l < f->count; l++) {
                double *end = w->transition + (size_t)f->kind[l] * transition_size(w);
                double *nodes = w->node_transition + (size_t)f->kind[l] * node_transition_size(w);
                if (f->fraction[l] == NODES)
                    end[(block * block_size + j) * block_size + i] = transition[l];
                else
                    nodes[((block * block_size + i) * block_size + j) * PADDED_NODES +
                          f->fraction[l]] = transition[l];
            }
        }
    for (int i = 0; i < block_size; i++)
        for (int m = 0; m < modes; m++)
            for (int force = 0; force < NODES; force++) {
                Register force_response = {0};
                for (int p = 0; p < NODES; p++)
                    force_response +=
                        w->weights[force * NODES + p] * w->phi[i * columns + p * modes + m];
                force_response /= w->scale[i];
                const ptrdiff_t at =
                    (ptrdiff_t)((block * block_size + i) * modes + m) * PADDED_NODES + force;
                for (int l = 0; l < f->count; l++) {
                    double *end = w->force_response + (size_t)f->kind[l] * force_response_size(w);
                    double *nodes =
                        w->node_force_response + (size_t)f->kind[l] * node_force_response_size(w);
                    if (f->fraction[l] == NODES) end[at] = force_response[l];
                    else
                        nodes[(size_t)f->fraction[l] * force_response_size(w) + (size_t)at] =
                            force_response[l];
                }
            }
}

/* Weights (force, power) of the powers of the polynomials, from forces at the nodes. */
static void set_force_weights(const Workspace *w, const Fractions *f) {
    for (int l = 0; l < REGISTER_WIDTH; l++) {
        const double fraction_of_step =
            l < f->count && f->fraction[l] < NODES ? w->inputs[GAUSS_NODES][f->fraction[l]] : 1;
        double power = f->length[l];
        for (int p = 0; p < NODES; p++, power *= fraction_of_step)
            for (int force = 0; force < NODES; force++) {
                const int at = force * NODES + p;
                w->weights[at][l] =
                    w->inputs[LAGRANGE_COEFFICIENTS][at] / INVERSE_FACTORIAL[p] * power;
            }
    }
}

/* Outputs at the peak nodes of a step, by its initial state and by forces on the modes. */
static void observe_propagators(const Workspace *w, int kind) {
    const int block_size = w->block_size, modes = w->modes, all_modes = w->all_modes;
    const int sample_count = w->sample_count, padded = padded_size(sample_count);
    const double *output_rows = w->inputs[OUTPUT_ROWS];
    const double *transition = w->transition + (size_t)kind * transition_size(w);
    const double *force_response = w->force_response + (size_t)kind * force_response_size(w);
    const double *node_transition = w->node_transition + (size_t)kind * node_transition_size(w);
    const double *node_force_response =
        w->node_force_response + (size_t)kind * node_force_response_size(w);
    double *sample_rows = w->sample_rows + (size_t)kind * sample_rows_size(w);
    double *sample_response = w->sample_response + (size_t)kind * sample_response_size(w);
    memset(sample_response, 0, 8 * sample_response_size(w));
    for (int point = 0; point < PEAK_POINTS; point++)
        for (int position = 0; position < w->positions; position++) {
            const int at = point * w->positions + position, node = point - 1;
            for (int state = 0; state < w->states; state++) {
                const int b = state / block_size, j = state % block_size;
                const double *row = output_rows + position * w->states + b * block_size;
                double sum = 0;
                for (int i = 0; i < block_size; i++) {
                    if (point == 0) sum += row[i] * (i == j);
                    else if (node == NODES)
                        sum += row[i] * transition[(b * block_size + j) * block_size + i];
                    else
                        sum +=
                            row[i] *
                            node_transition[((b * block_size + i) * block_size + j) * PADDED_NODES +
                                            node];
                }
                sample_rows[state * sample_count + at] = sum;
            }
            if (point == 0) continue;
            const double *responses =
                node == NODES ? force_response
                              : node_force_response + (size_t)node * force_response_size(w);
            for (int input = 0; input < all_modes; input++) {
                const int b = input / modes, k = input % modes;
                const double *row = output_rows + position * w->states + b * block_size;
                for (int force = 0; force < NODES; force++) {
                    double sum = 0;
                    for (int i = 0; i < block_size; i++)
                        sum += row[i] *
                               responses[((b * block_size + i) * modes + k) * PADDED_NODES + force];
                    sample_response[(force * all_modes + input) * padded + at] = sum;
                }
            }
        }
}

/* Propagators of all lengths that steps have. */
static void compute_propagators(Workspace *w) {
    memset(w->node_transition, 0, 8 * (size_t)w->lengths * node_transition_size(w));
    memset(w->node_force_response, 0, 8 * (size_t)w->lengths * node_force_response_size(w));
    memset(w->force_response, 0, 8 * (size_t)w->lengths * force_response_size(w));
    memset(w->length_used, 0, 8 * (size_t)w->lengths);
    for (int p = 0; p < w->panels; p++)
        if (panel_steps(w, p) > 0) w->length_used[length_of_panel(w, p)] = 1;
    int kind = 0, fraction = 0;
    for (Fractions f; (f = next_fractions(w, &kind, &fraction)).count;) {
        set_force_weights(w, &f);
        for (int b = 0; b < w->blocks; b++) {
            const double *matrix =
                w->inputs[STATE_MATRIX] + (ptrdiff_t)b * w->block_size * w->block_size;
            balance_states(w, matrix);
            block_exponential(w, matrix, f.length);
            store_propagators(w, b, &f);
        }
    }
    for (int k = 0; k < w->lengths; k++)
        if (w->length_used[k]) observe_propagators(w, k);
}
