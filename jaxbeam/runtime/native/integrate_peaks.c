/* Peaks of outputs and contact forces of several tasks, each a batch of runs that differ in their
 * loads: integrator/integrate.py, `integrate_peaks`, with commands of a sampled loop or without. Steps are advanced in
 * chunks. First the matrices of its steps are computed, which all runs of a task share; then groups
 * of runs, as many as fill a vector register, are advanced through all steps of the chunk, so that
 * their states stay in the first-level cache. native_peaks.py compiles this file and calls it. */

#include <stdlib.h>

#include "steps.h"

/* Initial state: at rest, without peaks. */
static void reset(Workspace *w) {
    const size_t batch_size = (size_t)w->batch_size, sampled = (size_t)w->positions * batch_size;
    memset(w->state, 0, 8 * (size_t)w->states * batch_size);
    w->peaks_final = 0;
    const size_t vehicle_bytes = 8 * (size_t)w->vehicle_states * batch_size;
    if (w->has_initial) memcpy(w->vehicle_state, w->inputs[INITIAL_VEHICLES], vehicle_bytes);
    else memset(w->vehicle_state, 0, vehicle_bytes);
    for (size_t i = 0; i < vehicle_propagator_count(w); i++) w->vehicle_kind[i] = -1;
    memset(w->peak_samples, 0, 8 * PEAK_POINTS * sampled);
    memset(w->peak, 0, 8 * sampled);
    memset(w->peak_step_start, 0, 8 * sampled);
    memset(w->peak_step_length, 0, 8 * sampled);
    for (size_t i = 0; i < (size_t)w->loads * batch_size; i++)
        w->lowest_force[i] = w->contact_loss_time[i] = INFINITY;
    for (size_t i = 0; i < batch_size; i++) w->finite[i] = 1;
    for (size_t i = 0; i < (size_t)w->memory_size; i++)
        for (size_t l = 0; l < batch_size; l++)
            w->memory[i * batch_size + l] = w->inputs[MEMORY][i];
    memset(w->amplitudes, 0, 8 * (size_t)w->marks * batch_size);
}

/* Steps of the next chunk, with their matrices; returns their number. `done` steps of the panel
 * and `before` of the task precede it. */
static int next_chunk(Workspace *w, int *panel, int64_t *done, int64_t before) {
    int count = 0;
    while (count < CHUNK_STEPS && *panel < w->panels) {
        if (*done >= panel_steps(w, *panel)) {
            ++*panel, *done = 0;
            continue;
        }
        Step *step = w->steps + count;
        step->number = before + count++;
        step->panel = *panel, step->kind = length_of_panel(w, *panel);
        step->length = w->inputs[STEP_LENGTHS][step->kind];
        step->event = step->sample = -1, step->mark = 0;
        if (w->loop && *done == 0) step->event = ((const int64_t *)w->inputs[EVENTS])[*panel];
        if (*done == 0) step->sample = sample_of_panel(w, *panel);
        step->start = w->inputs[PANEL_STARTS][*panel] + (double)(*done)++ * step->length;
        double mark = w->inputs[PANEL_STARTS][w->panels] / 2; /* the end, half of it, and so on */
        while (step->mark + 1 < w->marks && step->start <= mark) step->mark++, mark /= 2;
        step->transition = w->transition + (size_t)step->kind * transition_size(w);
        step->loads = 0;
        const uint8_t *active = (const uint8_t *)w->inputs[LOADS_ON_BEAM] + *panel * w->loads;
        const int loads = w->peaks_final ? 0 : w->loads; /* all have left, but for rounding */
        for (int prescribed = 1; prescribed >= 0; prescribed--) {
            for (int l = 0; l < loads && step->loads < w->max_loads; l++)
                if (active[l] && w->prescribed[l] == prescribed)
                    step->load_numbers[step->loads++] = l;
            if (prescribed) step->prescribed = step->loads;
        }
        step->rows = step->loads * NODES, step->ends = w->influence_terms ? 2 * step->loads : 0;
        if (!w->peaks_final) prepare_step(w, step);
    }
    return count;
}

/* Whether the force of each wheel is prescribed in all runs. */
static void find_prescribed(const Workspace *w) {
    for (int l = 0; l < w->loads; l++) {
        w->prescribed[l] = 1;
        for (ptrdiff_t run = 0; run < w->batch_size; run++)
            if (w->inputs[INERTIA][l * w->batch_size + run] != 0) w->prescribed[l] = 0;
    }
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        for (int64_t i = 0; i < numbers[COUNT] * numbers[WHEELS]; i++)
            w->prescribed[numbers[FIRST_WHEEL] + i] = 0;
    }
}

/* Time after which no load is on the beam. */
static double last_exit(const Workspace *w) {
    double last = 0;
    for (int l = 0; l < w->loads; l++) last = fmax(last, w->inputs[ON_BEAM_INTERVALS][2 * l + 1]);
    return last;
}

static void integrate_task(Workspace *w) {
    reset(w);
    prepare_task(w);
    set_vehicle_times(w);
    find_prescribed(w);
    const double exit_time = last_exit(w);
    int panel = 0;
    int64_t done = 0, before = 0;
    for (int steps; (steps = next_chunk(w, &panel, &done, before)); before += steps) {
        for (ptrdiff_t first = 0; first < w->batch_size;) {
            int groups = 0;
            for (; groups < INTERLEAVED_GROUPS && first < w->batch_size;
                 groups++, first += REGISTER_WIDTH) {
                w->groups[groups].first = first;
                w->groups[groups].count = runs_from(w, first);
            }
            advance_chunk(w, steps, w->groups, groups);
        }
        const Step *last = w->steps + steps - 1;
        if (w->loop) continue; /* commands may raise a peak later */
        if (w->peaks_final || last->start + last->length < exit_time || !peaks_final(w)) continue;
        if (!w->history_rows) break;
        w->peaks_final = 1; /* only the history goes on */
    }
    if (w->loop || w->history_rows) end_runs(w);
}

/* Outputs of a task, (run, position) and (run, load). */
static void write_results(const Workspace *w, int64_t task) {
    const ptrdiff_t batch_size = w->batch_size, plane = w->positions * batch_size;
    const ptrdiff_t sampled = task * plane, contact = task * w->loads * batch_size;
    for (int position = 0; position < w->positions; position++)
        for (ptrdiff_t first = 0; first < batch_size; first += REGISTER_WIDTH) {
            const int count = runs_from(w, first);
            const ptrdiff_t at = position * batch_size + first;
            Register samples[PEAK_POINTS];
            for (int p = 0; p < PEAK_POINTS; p++)
                samples[p] = load(w->peak_samples + p * plane + at, count);
            const Curve curve = curve_through(samples, w->inputs[INTERPOLATION]);
            const Register x = find_peak(&curve), peak = magnitude(&curve, x);
            const Register time = load(w->peak_step_start + at, count) +
                                  (x + 1) / 2 * load(w->peak_step_length + at, count);
            for (int l = 0; l < count; l++) {
                const ptrdiff_t to = sampled + (first + l) * w->positions + position;
                w->outputs[PEAK][to] = w->finite[first + l] ? peak[l] : NAN;
                w->outputs[PEAK_TIME][to] = w->finite[first + l] ? time[l] : NAN;
            }
        }
    for (ptrdiff_t l = 0; w->loop && l < batch_size; l++) {
        const ptrdiff_t run = task * batch_size + l;
        w->outputs[FAILURES][run] = w->memory[w->loop->failures * batch_size + l];
        for (int mark = 0; mark < w->marks; mark++)
            w->outputs[AMPLITUDES][run * w->marks + mark] = w->amplitudes[mark * batch_size + l];
    }
    for (int load = 0; load < w->loads; load++)
        for (ptrdiff_t l = 0; l < batch_size; l++) {
            const double loss_time = w->contact_loss_time[load * batch_size + l];
            w->outputs[LOWEST_FORCE][contact + l * w->loads + load] =
                w->lowest_force[load * batch_size + l];
            w->outputs[CONTACT_LOSS_TIME][contact + l * w->loads + load] =
                loss_time < INFINITY ? loss_time : NAN;
        }
}

/* Weights of the samples in the slopes of the interpolating polynomial at its ends. */
static void end_slopes(Workspace *w) {
    memset(w->end_slopes, 0, sizeof w->end_slopes);
    for (int i = 1; i < PEAK_POINTS; i++)
        for (int p = 0; p < PEAK_POINTS; p++) {
            const double slope = i * w->inputs[INTERPOLATION][p * PEAK_POINTS + i]; /* at 1 */
            w->end_slopes[p] += i % 2 ? slope : -slope;
            w->end_slopes[PEAK_POINTS + p] += slope;
        }
}

/* Integrate the tasks, and write their outputs, (task, run, position) or (task, run, load); 1 if
 * there is no memory for it. */
EXPORTED int integrate_peaks(int64_t max_loads, int64_t samples, int64_t absorbers,
                             const Array *arguments, double *const *outputs, const Loop *loop) {
    const int64_t *sizes[ARGUMENT_COUNT];
    for (int i = 0; i < ARGUMENT_COUNT; i++) sizes[i] = arguments[i].sizes;
    Workspace workspace = {.panels = (int)sizes[STEP_COUNTS][1],
                           .lengths = (int)sizes[STEP_LENGTHS][1],
                           .blocks = (int)sizes[STATE_MATRIX][1],
                           .block_size = (int)sizes[STATE_MATRIX][2],
                           .modes = (int)(sizes[SHAPE_SERIES][3] / sizes[STATE_MATRIX][1]),
                           .segments = (int)sizes[SHAPE_SERIES][1],
                           .terms = (int)sizes[SHAPE_SERIES][2],
                           .pieces = (int)sizes[BREAKPOINTS][2],
                           .max_loads = (int)max_loads,
                           .loads = (int)sizes[INERTIA][1],
                           .positions = (int)sizes[OUTPUT_ROWS][1],
                           .influence_pieces = (int)sizes[INFLUENCE_SERIES][1],
                           .influence_terms = (int)sizes[INFLUENCE_SERIES][2],
                           .batch_size = sizes[INERTIA][2],
                           .absorbers = (int)absorbers,
                           .input_entries = (int)sizes[VEHICLE_INPUT_MATRIX][1],
                           .groups_of_vehicles = (int)sizes[VEHICLES][1],
                           .vehicles = arguments[VEHICLES].numbers,
                           .has_surface = sizes[SURFACE][1] > 0,
                           .has_forces = sizes[LOAD_FORCES][1] > 0,
                           .has_initial = sizes[INITIAL_VEHICLES][1] > 0,
                           .forced_runs = sizes[LOAD_FORCES][3],
                           .surface_runs = sizes[SURFACE][3],
                           .vehicle_runs = sizes[VEHICLE_STATE_MATRIX][2],
                           .shares_lengths = sizes[LENGTHS_OF_PANELS][1] > 0,
                           .history_rows = samples ? (int)sizes[HISTORY_ROWS][1] : 0,
                           .samples = samples,
                           .loop = loop,
                           .memory_size = (int)sizes[MEMORY][1],
                           .outputs = outputs};
    Workspace *w = &workspace;
    derive_sizes(w);
    void *memory = malloc(partition_workspace(w, 0) + sizeof(Register)); /* Windows aligns none */
    if (!memory) return 1;
    partition_workspace(w, ((uintptr_t)memory + sizeof(Register) - 1) & -sizeof(Register));
    for (int64_t task = 0; task < sizes[MASK][0]; task++) {
        w->task = task;
        set_inputs(w, arguments, task);
        if (task == 0) end_slopes(w);
        if (*(const uint8_t *)w->inputs[MASK]) integrate_task(w);
        else reset(w);
        write_results(w, task);
    }
    free(memory);
    return 0;
}
