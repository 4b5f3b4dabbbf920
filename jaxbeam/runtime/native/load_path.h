/* Load path over a step: integrator/load_path.py. */

#pragma once

#include "matrices.h"
#include "workspace.h"

/* Chebyshev series (segment, term, derivative and mode) of mode shapes and their first two
 * derivatives by position. */
static void shape_series(Workspace *w) {
    const int terms = w->terms, modes = w->all_modes, columns = w->columns;
    for (int s = 0; s < w->segments; s++) {
        const double half = (w->inputs[SHAPE_NODES][s + 1] - w->inputs[SHAPE_NODES][s]) / 2;
        double *series = w->series + (ptrdiff_t)s * terms * columns;
        for (int k = 0; k < terms; k++)
            memcpy(series + k * columns, w->inputs[SHAPE_SERIES] + (s * terms + k) * modes,
                   8 * (size_t)modes);
        for (int d = modes; d < columns; d += modes) {
            /* Recurrence of the coefficients of a derivative, from the highest down. */
            double *here = series + d;
            memset(here + (terms - 1) * columns, 0, 8 * (size_t)modes);
            for (int k = terms - 2; k >= 0; k--)
                for (int m = 0; m < modes; m++) {
                    double above = k + 2 < terms ? here[(k + 2) * columns + m] : 0;
                    here[k * columns + m] =
                        above + 2 * (k + 1) * here[(k + 1) * columns + m - modes];
                }
            for (int m = 0; m < modes; m++) here[m] /= 2;
        }
        for (int k = 0; k < terms; k++)
            for (int c = modes; c < columns; c++)
                series[k * columns + c] /= c < 2 * modes ? half : half * half;
    }
}

/* Mode shapes and their first two derivatives at positions x, in `shape_sums`. */
static void evaluate_shapes(const Workspace *w, Register x) {
    const double *nodes = w->inputs[SHAPE_NODES];
    const size_t size = (size_t)w->columns * sizeof(Register);
    Register *sums = w->shape_sums, *segment_sums = w->shape_sums + w->columns,
             *chebyshev = w->chebyshev;
    for (int s = 0; s < w->segments; s++) {
        Mask here = ~(Mask){0};
        if (s > 0) here &= x >= nodes[s];
        if (s < w->segments - 1) here &= x < nodes[s + 1];
        if (!any(here)) continue;
        Register local = 2 * (x - nodes[s]) / (nodes[s + 1] - nodes[s]) - 1;
        chebyshev[0] = broadcast(1);
        if (w->terms > 1) chebyshev[1] = local;
        for (int k = 2; k < w->terms; k++) /* doubling the index preserves accuracy */
            chebyshev[k] = 2 * chebyshev[k / 2] * chebyshev[k - k / 2] - chebyshev[k % 2];
        memset(segment_sums, 0, size);
        add_product(segment_sums, w->series + (ptrdiff_t)s * w->terms * w->columns, w->columns,
                    chebyshev, w->terms);
        for (int c = 0; c < w->columns; c++) sums[c] = choose(here, segment_sums[c], sums[c]);
    }
}

/* Position (m), speed (m/s) and acceleration (m/s^2) of a load. */
static void evaluate_trajectory(const Workspace *w, int64_t load, double time, double *position,
                                double *speed, double *acceleration) {
    const double *breakpoints = w->inputs[BREAKPOINTS] + load * w->pieces;
    int piece = 0;
    for (int end = w->pieces; end - piece > 1;) {
        int middle = (piece + end) / 2;
        if (breakpoints[middle] <= time) piece = middle;
        else end = middle;
    }
    const double *c = w->inputs[CUBICS] + (load * w->pieces + piece) * 4,
                 t = time - breakpoints[piece];
    *position = c[0] + t * (c[1] + t * (c[2] + t * c[3]));
    *speed = c[1] + t * (2 * c[2] + t * 3 * c[3]);
    *acceleration = 2 * c[2] + t * 6 * c[3];
}

/* Rows (load, state, node) of a motion of the beam under the loads. */
static double *motion_rows(const Workspace *w, int motion) {
    return w->contact_rows + (ptrdiff_t)motion * w->max_loads * w->states * PADDED_NODES;
}

static const double END_FRACTIONS[2] = {1e-9, 1 - 1e-9}; /* peaks/end_forces.py */

/* Mode shapes (mode, node) and rows (state, node) of motions under the loads of a step:
 * model/contact.py, `surface_rows`. After the Gauss nodes the start and the end of the step, if it
 * uses them: their limits within it, where the acceleration of a load jumps. */
static void load_path(const Workspace *w, const Step *step) {
    const int block_size = w->block_size, modes = w->modes, all_modes = w->all_modes;
    const int used = step->ends ? PATH_NODES : NODES;
    for (int s = 0; s < step->loads; s++) {
        double position[PADDED_NODES], speed[PADDED_NODES], acceleration[PADDED_NODES];
        for (int k = 0; k < PADDED_NODES; k++) {
            const double fraction = k < NODES ? w->inputs[GAUSS_NODES][k] : END_FRACTIONS[k > NODES];
            evaluate_trajectory(w, step->load_numbers[s], step->start + step->length * fraction,
                                position + k, speed + k, acceleration + k);
        }
        for (int first = 0; first < used; first += REGISTER_WIDTH) {
            const Register v = load_full(speed + first), a = load_full(acceleration + first);
            double *shape = w->shape + (ptrdiff_t)s * all_modes * PADDED_NODES + first;
            const ptrdiff_t at = (ptrdiff_t)s * w->states * PADDED_NODES + first;
            evaluate_shapes(w, load_full(position + first));
            const Register *value = w->shape_sums, *slope = value + all_modes,
                           *curvature = slope + all_modes;
            for (int m = 0; m < all_modes; m++)
                store(shape + m * PADDED_NODES, value[m], REGISTER_WIDTH);
            for (int i = 0; i < w->states; i++) {
                const int b = i / block_size, j = i % block_size, m = b * modes + j / 2;
                const double *rates =
                    w->inputs[STATE_MATRIX] + ((ptrdiff_t)b * block_size + 1) * block_size + j;
                Register row = {0};
                for (int n = 0; n < modes; n++)
                    row += value[b * modes + n] * rates[2 * n * block_size];
                if (j < 2 * modes)
                    row += j % 2 ? 2 * v * slope[m] : v * v * curvature[m] + a * slope[m];
                store(motion_rows(w, ACCELERATION) + at + i * PADDED_NODES, row, REGISTER_WIDTH);
                if (w->motions == 1) continue;
                const Register zero = {0};
                const int is_state = j < 2 * modes, is_rate = j % 2;
                store(motion_rows(w, DEFLECTION) + at + i * PADDED_NODES,
                      is_state && !is_rate ? value[m] : zero, REGISTER_WIDTH);
                store(motion_rows(w, VELOCITY) + at + i * PADDED_NODES,
                      !is_state ? zero : is_rate ? value[m] : v * slope[m], REGISTER_WIDTH);
            }
        }
    }
}

/* Static influence of a load on the outputs at the peak nodes of a step, added to its sample rows:
 * model/output_rows.py, `LoadInfluence`. No step contains a break inside. */
static void add_influence(const Workspace *w, const Step *step, int s) {
    const double *breaks = w->inputs[INFLUENCE_BREAKS];
    double position, speed, acceleration;
    evaluate_trajectory(w, step->load_numbers[s], step->start + step->length / 2, &position, &speed,
                        &acceleration);
    int piece = 0;
    while (piece < w->influence_pieces - 1 && position >= breaks[piece + 1]) piece++;
    const double left = breaks[piece], width = breaks[piece + 1] - left;
    const double *series = w->inputs[INFLUENCE_SERIES] +
                           (ptrdiff_t)piece * w->influence_terms * w->positions;
    /* Peak nodes side by side in a register, since each term of the series waits for the last. */
    for (int first = 0; first < PEAK_POINTS; first += REGISTER_WIDTH) {
        const int left_over = PEAK_POINTS - first;
        const int count = left_over < REGISTER_WIDTH ? left_over : REGISTER_WIDTH;
        Register x = {0};
        for (int p = 0; p < count; p++) {
            const double fraction = w->inputs[PEAK_FRACTIONS][first + p];
            evaluate_trajectory(w, step->load_numbers[s], step->start + step->length * fraction,
                                &position, &speed, &acceleration);
            x[p] = fmin(fmax(2 * (position - left) / width - 1, -1), 1);
        }
        const Register twice = 2 * x;
        for (int output = 0; output < w->positions; output++) {
            Register sum = {0}, above = {0}; /* Clenshaw's recurrence */
            for (int k = w->influence_terms - 1; k > 0; k--) {
                const Register next = series[k * w->positions + output] - above + twice * sum;
                above = sum, sum = next;
            }
            sum = series[output] - above + x * sum;
            for (int p = 0; p < count; p++) {
                const int point = first + p; /* the start, the Gauss nodes, the end */
                const int is_node = point > 0 && point <= NODES;
                const int row = is_node ? s * NODES + point - 1 : step->rows + 2 * s + (point > 0);
                step->sample_rows[(ptrdiff_t)(w->states + row) * w->sample_count +
                                  point * w->positions + output] += sum[p];
            }
        }
    }
}
