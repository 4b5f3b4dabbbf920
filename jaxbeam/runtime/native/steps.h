/* A chunk of steps for a group of runs: integrator/step.py, `advance`, and
 * integrator/peaks/running_peaks.py, `update_peaks`, without commands. */

#pragma once

#include "matrices.h"
#include "peak_search.h"
#include "preparation.h"
#include "vehicles.h"

/* Zero of the polynomial through the forces of a load at the Gauss nodes, near a start, which stays
 * if it is 0 or infinite: peaks/contact_minimum.py. */
static Register zero_nearby(const double *lagrange, const Register *forces, Register start) {
    Register powers[NODES] = {{0}}, slopes[NODES - 1];
    add_product(powers, lagrange, NODES, forces, NODES);
    for (int k = 1; k < NODES; k++) slopes[k - 1] = k * powers[k];
    const Mask inside = (start > 0) & (start <= 1);
    const Register first = choose(inside, start, broadcast(0.5));
    const Register low = maximum(first - FORCE_GAP, broadcast(0)),
                   high = minimum(first + FORCE_GAP, broadcast(1));
    Register x = first;
    for (int r = 0; r < ZERO_ITERATIONS; r++) {
        const Register slope = polynomial(slopes, NODES - 1, x);
        const Register divisor = choose(slope == 0, broadcast(1), slope);
        x = minimum(maximum(x - polynomial(powers, NODES, x) / divisor, low), high);
    }
    const Register left = absolute(polynomial(powers, NODES, x)),
                   before = absolute(polynomial(powers, NODES, first));
    return choose(inside & (left <= before), x, start);
}

/* Largest pull of a load in a step, from its forces at fractions of it, and the first fraction with
 * a pull, infinite without one: peaks/contact_minimum.py. */
static Register largest_pull(const double *fractions, const Register *pulls, Register *first) {
    Register most = pulls[0], at = choose(pulls[0] > 0, broadcast(0), broadcast(INFINITY));
    for (int p = 1; p < FORCE_POINTS; p++) {
        const double gap = fractions[p] - fractions[p - 1];
        const Register former = pulls[p - 1], here = pulls[p], rise = (here - former) / gap;
        const Mask crosses = (former <= 0) & (here > 0);
        if (any(crosses)) {
            Register zero = fractions[p - 1] + gap * (former / (former - here));
            at = choose(crosses, minimum(zero, at), at);
        }
        most = maximum(here, most);
        if (p == FORCE_POINTS - 1) break;
        const double next_gap = fractions[p + 1] - fractions[p];
        const Register fall = (pulls[p + 1] - here) / next_gap;
        const Mask inside = (rise > 0) & (fall < 0);
        if (!any(inside)) continue;
        const Register curvature = (fall - rise) / (gap + next_gap), slope = rise + curvature * gap;
        const Register top = here - slope * slope / (4 * curvature);
        const Mask touches = inside & (top > 0) & (here <= 0);
        most = choose(inside, maximum(top, most), most);
        if (!any(touches)) continue;
        const Register square = choose(touches, top / -curvature, broadcast(0));
        Register rising = fractions[p] - slope / (2 * curvature);
        for (int l = 0; l < REGISTER_WIDTH; l++) rising[l] -= sqrt(square[l]);
        at = choose(touches, minimum(rising, at), at);
    }
    *first = at;
    return most;
}

/* Smallest contact forces so far, and the first times at which they are tensile. */
static void update_contact_minimum(const Workspace *w, const Step *step, const Group *g) {
    for (int s = 0; s < step->loads; s++) {
        const Register *forces = g->state + w->states + s * NODES;
        const ptrdiff_t at = step->load_numbers[s] * w->batch_size + g->first;
        Register most = forces[0], least = forces[0];
        for (int k = 1; k < NODES; k++)
            most = maximum(forces[k], most), least = minimum(forces[k], least);
        const Register lowest = load(w->lowest_force + at, g->count),
                       loss_time = load(w->contact_loss_time + at, g->count),
                       bound = 0.5 * (most + least) + SPREAD_FACTOR * (most - least);
        if (!any((bound > -lowest) | ((bound > 0) & (loss_time == INFINITY)))) continue;
        Register pulls[FORCE_POINTS] = {{0}}, first;
        const double *weights = w->inputs[FORCE_WEIGHTS];
        for (int p = 0; p < FORCE_POINTS; p++, weights += NODES)
            for (int k = 0; k < NODES; k++) pulls[p] += weights[k] * forces[k];
        most = largest_pull(w->inputs[FORCE_FRACTIONS], pulls, &first);
        store(w->lowest_force + at, minimum(-most, lowest), g->count);
        if (!any(first <= 1)) continue;
        first = zero_nearby(w->inputs[LAGRANGE_COEFFICIENTS], forces, first);
        store(w->contact_loss_time + at, minimum(step->start + step->length * first, loss_time),
              g->count);
    }
}

/* Contact forces at the Gauss nodes of a step, for a number of loads that may be known when
 * compiling. */
static inline ALWAYS_INLINE void contact_forces(const Workspace *w, const Step *step,
                                                const Group *g, int loads, Register *matrix,
                                                Register *forces) {
    const int rows = loads * NODES;
    memset(forces, 0, (size_t)rows * sizeof *forces);
    add_product(forces, step->contact_response[ACCELERATION], rows, g->state, w->states);
    for (int s = 0; s < loads; s++) {
        const ptrdiff_t at = step->load_numbers[s] * w->batch_size + g->first;
        Register mass = load(w->inputs[INERTIA] + at, g->count),
                 weight = load(w->inputs[WEIGHT] + at, g->count);
        for (int i = s * NODES; i < (s + 1) * NODES; i++) {
            forces[i] = -(weight + mass * forces[i]);
            for (int j = 0; j < rows; j++)
                matrix[i * rows + j] = mass * step->contact_compliance[ACCELERATION][i * rows + j];
            matrix[i * rows + i] += 1;
        }
    }
    if (w->groups_of_vehicles) add_vehicles(w, step, g, loads, matrix, forces);
    solve_contact_system(matrix, forces, rows);
}

static void solve_contact(const Workspace *w, const Step *step, const Group *g) {
    if (step->loads == 1) { /* the matrix fits into registers */
        Register matrix[NODES * NODES], forces[NODES];
        contact_forces(w, step, g, 1, matrix, forces);
        memcpy(g->state + w->states, forces, sizeof forces);
    } else {
        contact_forces(w, step, g, step->loads, g->matrix, g->state + w->states);
    }
}

/* Contact forces at the ends of a step from the states there, before and after it. Those of
 * vehicles are extrapolated from the Gauss nodes: peaks/end_forces.py. */
static void end_forces(const Workspace *w, const Step *step, const Group *g) {
    const int loads = step->loads;
    Register *forces = g->next_state + w->states, *found = forces + step->rows;
    for (int end = 0; end < 2; end++) {
        Register *right = g->end_forces, *matrix = g->matrix;
        memset(right, 0, (size_t)loads * sizeof *right);
        if (w->groups_of_vehicles) {
            const double *weights =
                w->inputs[FORCE_WEIGHTS] + (end ? (FORCE_POINTS - 1) * NODES : 0);
            for (int s = 0; s < loads; s++)
                for (int k = 0; k < NODES; k++) right[s] += weights[k] * forces[s * NODES + k];
        } else {
            add_product(right, step->end_response + (ptrdiff_t)end * loads * w->states, loads,
                        end ? g->state : g->next_state, w->states);
            for (int s = 0; s < loads; s++) {
                const ptrdiff_t at = step->load_numbers[s] * w->batch_size + g->first;
                const Register mass = load(w->inputs[INERTIA] + at, g->count);
                right[s] = -(load(w->inputs[WEIGHT] + at, g->count) + mass * right[s]);
                for (int q = 0; q < loads; q++)
                    matrix[s * loads + q] =
                        mass * step->end_compliance[(end * loads + s) * loads + q];
                matrix[s * loads + s] += 1;
            }
            solve_contact_system(matrix, right, loads);
        }
        for (int s = 0; s < loads; s++) found[2 * s + end] = right[s];
    }
}

/* Deflections at the peak nodes of a step, the largest of them, and a bound of those between; from
 * the state before the step. */
static void sample_positions(const Workspace *w, int t, const Step *step, const Group *g) {
    Register *sampled = g->samples + t * w->sample_count;
    memset(sampled, 0, (size_t)w->sample_count * sizeof *sampled);
    add_product(sampled, step->sample_rows, w->sample_count, g->next_state,
                w->states + step->rows + step->ends);
    for (int position = 0; position < w->positions; position++) {
        Register largest = {0};
        for (int i = position; i < w->sample_count; i += w->positions)
            largest = maximum(absolute(sampled[i]), largest);
        g->sample_peak[t * w->positions + position] = largest;
        g->peak_bound[t * w->positions + position] = peak_bound_within(
            sampled[position], sampled[w->sample_count - w->positions + position], largest);
    }
}

/* State at the end of a step; a block of two states is an uncoupled mode. */
static void propagate(const Workspace *w, const Step *step, Group *g) {
    const double *transition = step->transition;
    Register *state = g->state, *next_state = g->next_state;
    if (w->block_size == 2) {
        for (int i = 0; i < w->states; i += 2, transition += 4) {
            next_state[i] = transition[0] * state[i] + transition[2] * state[i + 1];
            next_state[i + 1] = transition[1] * state[i] + transition[3] * state[i + 1];
        }
    } else {
        memset(next_state, 0, (size_t)w->states * sizeof *next_state);
        for (int i = 0; i < w->states;
             i += w->block_size, transition += w->block_size * w->block_size)
            add_product(next_state + i, transition, w->block_size, state + i, w->block_size);
    }
    if (step->loads)
        add_product(next_state, step->force_response, w->states, state + w->states, step->rows);
    g->state = next_state, g->next_state = state;
}

/* Peaks so far, from the samples of all steps of the chunk. */
static void update_peaks(const Workspace *w, int steps, const Group *g, int position) {
    const int count = g->count;
    const ptrdiff_t at = position * w->batch_size + g->first, plane = w->positions * w->batch_size;
    const Register *sampled = g->samples + position;
    Register former = load(w->peak + at, count), reached = former, peak = former, top = {0};
    for (int t = 0; t < steps; t++)
        reached = maximum(g->sample_peak[t * w->positions + position], reached);
    for (int t = 0; t < steps; t++) {
        /* Only a step whose bound exceeds all samples can have the peak. */
        Register found = g->sample_peak[t * w->positions + position];
        Mask candidate = g->peak_bound[t * w->positions + position] > reached;
        if (!any(candidate)) continue;
        Register samples[PEAK_POINTS];
        for (int p = 0; p < PEAK_POINTS; p++)
            samples[p] = sampled[(t * PEAK_POINTS + p) * w->positions];
        if (any(candidate & peak_inside(samples, w->end_slopes, found)))
            found = estimate_peak(samples, w->inputs[INTERPOLATION], w->inputs[PEAK_FRACTIONS]);
        top = choose(found > peak, broadcast(t), top);
        peak = maximum(found, peak);
    }
    Mask better = peak > former;
    if (!any(better)) return;
    store(w->peak + at, peak, count);
    for (int t = 0; t < steps; t++) {
        Mask here = better & (top == broadcast(t));
        if (!any(here)) continue;
        for (int p = 0; p < PEAK_POINTS; p++) {
            double *stored = w->peak_samples + p * plane + at;
            store(stored,
                  choose(here, sampled[(t * PEAK_POINTS + p) * w->positions], load(stored, count)),
                  count);
        }
        const Step *step = w->steps + t;
        store(w->peak_step_start + at,
              choose(here, broadcast(step->start), load(w->peak_step_start + at, count)), count);
        store(w->peak_step_length + at,
              choose(here, broadcast(step->length), load(w->peak_step_length + at, count)), count);
    }
}

/* States of beam and vehicles of a group of runs. */
static void load_states(const Workspace *w, const Group *g) {
    for (int i = 0; i < w->states; i++)
        g->state[i] = load(w->state + i * w->batch_size + g->first, g->count);
    for (int i = 0; i < w->vehicle_states; i++)
        g->vehicle_state[i] = load(w->vehicle_state + i * w->batch_size + g->first, g->count);
}

/* All steps of the chunk for a few groups, interleaved: while the divisions of one wait, another
 * computes. */
static void advance_chunk(Workspace *w, int steps, Group *groups, int group_count) {
    Group *end = groups + group_count;
    for (const Group *g = groups; g < end; g++)
        load_states(w, g);
    for (int t = 0; t < steps; t++) {
        const Step *step = w->steps + t;
        const int vehicles = vehicles_move(w, step);
        if (vehicles)
            for (const Group *g = groups; g < end; g++) prepare_vehicles(w, step, g);
        if (step->loads) {
            for (const Group *g = groups; g < end; g++) solve_contact(w, step, g);
            for (const Group *g = groups; g < end; g++) update_contact_minimum(w, step, g);
        }
        for (Group *g = groups; g < end; g++) {
            if (vehicles) propagate_vehicles(w, step, g);
            propagate(w, step, g);
        }
        if (step->ends)
            for (const Group *g = groups; g < end; g++) end_forces(w, step, g);
        for (const Group *g = groups; g < end; g++) sample_positions(w, t, step, g);
    }
    for (const Group *g = groups; g < end; g++) {
        for (int position = 0; position < w->positions; position++)
            update_peaks(w, steps, g, position);
        for (int i = 0; i < w->vehicle_states; i++)
            store(w->vehicle_state + i * w->batch_size + g->first, g->vehicle_state[i], g->count);
        Register zero = {0}; /* NaN if a state is infinite or NaN, which it then stays */
        for (int i = 0; i < w->states; i++) {
            store(w->state + i * w->batch_size + g->first, g->state[i], g->count);
            zero += 0 * g->state[i];
        }
        double *finite = w->finite + g->first;
        store(finite, choose(zero == 0, load(finite, g->count), broadcast(0)), g->count);
    }
}

/* Whether the energies left in the blocks cannot raise any peak, by the bounds of the outputs.
 * Diverged runs cannot. */
static int peaks_final(const Workspace *w) {
    const int block_size = w->block_size, modes = w->modes;
    Register *root = w->root_energy;
    for (ptrdiff_t first = 0; first < w->batch_size; first += REGISTER_WIDTH) {
        const int count = runs_from(w, first);
        Register sum = {0}; /* NaN or infinite in a diverged run */
        for (int b = 0; b < w->blocks; b++) {
            const double *state = w->state + b * block_size * w->batch_size + first;
            const double *matrix = w->inputs[STATE_MATRIX] + b * block_size * block_size;
            Register energy = {0};
            for (int i = 0; i < 2 * modes; i += 2) {
                Register rate = load(state + (i + 1) * w->batch_size, count), pull = {0};
                for (int j = 0; j < 2 * modes; j += 2)
                    pull -=
                        matrix[(i + 1) * block_size + j] * load(state + j * w->batch_size, count);
                energy += rate * rate + load(state + i * w->batch_size, count) * pull;
            }
            for (int l = 0; l < REGISTER_WIDTH; l++) root[b][l] = sqrt(energy[l]);
            sum += root[b];
        }
        const Mask finite = 0 * sum == 0;
        for (int position = 0; position < w->positions; position++) {
            const double *bounds = w->inputs[OUTPUT_BOUNDS] + position * w->blocks;
            Register reach = {0};
            for (int b = 0; b < w->blocks; b++) reach += bounds[b] * root[b];
            Mask above = finite & ~(reach < load(w->peak + position * w->batch_size + first, count));
            for (int l = 0; l < count; l++)
                if (above[l]) return 0;
        }
    }
    return 1;
}
