/* A chunk of steps for a group of runs: integrator/step.py, `advance`, and
 * integrator/peaks.py, `update_peaks`, with commands as states. */

#pragma once

#include "contact.h"
#include "matrices.h"
#include "peak_search.h"
#include "preparation.h"

/* Stiffness of a mode of a block. */
static double stiffness_of_mode(const Workspace *w, int block, int mode) {
    const double *matrix = w->inputs[STATE_MATRIX] + block * w->block_size * w->block_size;
    return fabs(matrix[(2 * mode + 1) * w->block_size + 2 * mode]);
}

/* Amplitude of a state, squared: integrator/inputs.py, `amplitudes`. */
static Register squared_amplitude(const Workspace *w, const Register *state) {
    Register square = {0};
    for (int b = 0; b < w->blocks; b++, state += w->block_size)
        for (int m = 0; m < w->modes; m++)
            square += state[2 * m + 1] * state[2 * m + 1] +
                      stiffness_of_mode(w, b, m) * (state[2 * m] * state[2 * m]);
    return square;
}

/* What happens at an event of a loop: samples and commands, which are the last states of blocks. */
static void process_event(const Workspace *w, const Step *step, const Group *g) {
    const int own = w->block_size - w->commands;
    for (int b = 0; b < w->blocks; b++)
        memcpy(g->plant_state + b * own, g->state + b * w->block_size,
               (size_t)own * sizeof(Register));
    w->loop->process((const void *const *)w->inputs[LOOP_NUMBERS], step->event, step->start,
                     g->memory, g->plant_state, g->commands);
    for (int b = 0; b < w->blocks; b++)
        memcpy(g->state + b * w->block_size + own, g->commands,
               (size_t)w->commands * sizeof(Register));
}

/* Outputs of the history at a sample, of the states of a group of runs. */
static void write_sample(const Workspace *w, int64_t sample, const Group *g) {
    const ptrdiff_t of_run = w->samples * w->history_rows;
    double *history = w->outputs[HISTORY] + (w->task * w->batch_size + g->first) * of_run;
    const double *weights = w->inputs[HISTORY_ROWS];
    for (int row = 0; row < w->history_rows; row++) {
        Register value = {0};
        for (int i = 0; i < w->states; i++) value += *weights++ * g->state[i];
        double *to = history + sample * w->history_rows + row;
        for (int l = 0; l < g->count; l++, to += of_run) *to = value[l];
    }
}

/* Strokes, and forces, of absorbers at the peak nodes of a step, in place of the deflections there:
 * integrator/vehicles.py, `absorber_samples`. */
static void sample_absorbers(const Workspace *w, const Step *step, const Group *g,
                             Register *sampled) {
    enum { ABSORBER_STATES = 2 };
    const Register length = broadcast(step->length), *end = sampled + w->sample_count - w->positions;
    for (int a = 0; a < w->absorbers; a++) {
        const int behind = w->absorbers - a, wheel = w->loads - behind, first = w->positions - behind;
        const int of_stroke = first - w->absorbers, at = w->vehicle_states - ABSORBER_STATES * behind;
        const int64_t entry = w->input_entries - ABSORBER_STATES * behind + 1;
        const double *mobility = w->inputs[VEHICLE_INPUT_MATRIX] + entry * w->vehicle_runs;
        const Register body = 1 / of_group(mobility, w->vehicle_runs, g);
        const Register inertia =
            body + load(w->inputs[INERTIA] + wheel * w->batch_size + g->first, g->count);
        const Register fraction = body / inertia, scale = length * length / inertia;
        Register z_first = g->next_vehicle_state[at], z_last = g->vehicle_state[at];
        if (w->has_surface) {
            const Register height = profile_motion(w, step, g, wheel, HEIGHT, 0);
            z_first -= height, z_last -= height;
        }
        const Register u_first = fraction * z_first + (1 - fraction) * sampled[of_stroke],
                       u_last = fraction * z_last + (1 - fraction) * end[of_stroke];
        Register none[NODES] = {{0}};
        const Register *forces = none;
        for (int s = 0; s < step->loads; s++)
            if (step->load_numbers[s] == wheel) forces = g->next_state + w->states + s * NODES;
        const double *weights = w->inputs[ABSORBER_WEIGHTS];
        for (int p = 0; p < PEAK_POINTS; p++, weights += NODES) {
            const double c = w->inputs[PEAK_FRACTIONS][p];
            Register pulled = {0}, moved = {0}, *sample = sampled + p * w->positions;
            for (int k = 0; k < NODES; k++) {
                pulled -= weights[k] * forces[k];
                moved -= weights[PEAK_POINTS * NODES + k] * forces[k];
            }
            sample[of_stroke] = (1 - c) * u_first + c * u_last + scale * moved - sample[of_stroke];
            sample[first] = pulled;
        }
    }
}

/* Deflections at the peak nodes of a step, the largest of them, and a bound of those between; from
 * the state before the step. */
static void sample_positions(const Workspace *w, int t, const Step *step, const Group *g) {
    Register *sampled = g->samples + t * w->sample_count;
    memset(sampled, 0, (size_t)w->sample_count * sizeof *sampled);
    add_product(sampled, step->sample_rows, w->sample_count, g->next_state,
                w->states + step->rows + step->ends);
    if (w->absorbers) sample_absorbers(w, step, g, sampled);
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
    for (int i = 0; i < w->memory_size; i++)
        g->memory[i] = load(w->memory + i * w->batch_size + g->first, g->count);
    for (int i = 0; i < w->marks; i++)
        g->amplitudes[i] = load(w->amplitudes + i * w->batch_size + g->first, g->count);
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
        if (w->loop)
            for (const Group *g = groups; g < end; g++) {
                g->amplitudes[step->mark] =
                    maximum(squared_amplitude(w, g->state), g->amplitudes[step->mark]);
                if (step->event >= 0) process_event(w, step, g);
            }
        if (step->sample >= 0)
            for (const Group *g = groups; g < end; g++) write_sample(w, step->sample, g);
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
        for (const Group *g = groups; g < end && !w->peaks_final; g++)
            sample_positions(w, t, step, g);
    }
    for (const Group *g = groups; g < end; g++) {
        for (int position = 0; position < w->positions && !w->peaks_final; position++)
            update_peaks(w, steps, g, position);
        for (int i = 0; i < w->vehicle_states; i++)
            store(w->vehicle_state + i * w->batch_size + g->first, g->vehicle_state[i], g->count);
        for (int i = 0; i < w->memory_size; i++)
            store(w->memory + i * w->batch_size + g->first, g->memory[i], g->count);
        for (int i = 0; i < w->marks; i++)
            store(w->amplitudes + i * w->batch_size + g->first, g->amplitudes[i], g->count);
        Register zero = {0}; /* NaN if a state is infinite or NaN, which it then stays */
        for (int i = 0; i < w->states; i++) {
            store(w->state + i * w->batch_size + g->first, g->state[i], g->count);
            zero += 0 * g->state[i];
        }
        double *finite = w->finite + g->first;
        store(finite, choose(zero == 0, load(finite, g->count), broadcast(0)), g->count);
    }
}

/* What is known at the end of a run: amplitudes of a loop, and the last sample of a history. */
static void end_runs(Workspace *w) {
    Group *g = w->groups;
    const int64_t sample = sample_of_panel(w, w->panels);
    for (g->first = 0; g->first < w->batch_size; g->first += REGISTER_WIDTH) {
        g->count = runs_from(w, g->first);
        load_states(w, g);
        if (sample >= 0) write_sample(w, sample, g);
        if (!w->loop) continue;
        const Register largest = maximum(squared_amplitude(w, g->state), g->amplitudes[0]);
        store(w->amplitudes + g->first, largest, g->count);
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
