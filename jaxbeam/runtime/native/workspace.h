/* Arguments, outputs and workspace of a call. CHUNK_STEPS are steps of a chunk, NODES Gauss nodes of
 * a step, PEAK_POINTS its samples, FORCE_POINTS fractions at which its forces are compared. A last
 * axis of nodes or samples is padded to a multiple of PADDING. */

#pragma once

#include <math.h>

#include "constants.h"
#include "registers.h"

enum { PADDED_NODES = (NODES + PADDING - 1) / PADDING * PADDING };
enum { STEP_FRACTIONS = NODES + 1 }; /* Gauss nodes and end of a step */
enum { PATH_NODES = NODES + 2 };     /* Gauss nodes, start and end of a step; no more than padded */
enum { INTERLEAVED_GROUPS = 2 };     /* groups of runs that are advanced together */

/* An argument of the call: its numbers, and the sizes of its axes, 1 beyond the last. */
enum { MAX_AXES = 4 };
typedef struct {
    const void *numbers;
    int64_t sizes[MAX_AXES];
} Array;

/* Arguments of the call, with tasks as the first axis, of length one if shared: modal model, panels
 * of the time grid, trajectories, loads, outputs, constants. */
enum {
    MASK,
    STATE_MATRIX,
    SHAPE_NODES,
    SHAPE_SERIES,
    PANEL_STARTS,
    STEP_COUNTS,
    STEP_LENGTHS,
    LOADS_ON_BEAM,
    ON_BEAM_INTERVALS,
    BREAKPOINTS,
    CUBICS,
    INERTIA,
    WEIGHT,
    STIFFNESS,
    DAMPING,
    VEHICLES,
    VEHICLE_STATE_MATRIX,
    VEHICLE_INPUT_MATRIX,
    VEHICLE_OUTPUT_MATRIX,
    OUTPUT_ROWS,
    OUTPUT_BOUNDS,
    INFLUENCE_BREAKS,
    INFLUENCE_SERIES,
    SURFACE,
    LOAD_FORCES,
    INITIAL_VEHICLES,
    LENGTHS_OF_PANELS,
    EVENTS,
    MEMORY,
    LOOP_NUMBERS,
    SAMPLES,
    HISTORY_ROWS,
    GAUSS_NODES,
    LAGRANGE_COEFFICIENTS,
    INTERPOLATION,
    PEAK_FRACTIONS,
    FORCE_FRACTIONS,
    FORCE_WEIGHTS,
    ABSORBER_WEIGHTS,
    ARGUMENT_COUNT
};
enum {
    PEAK,
    PEAK_TIME,
    LOWEST_FORCE,
    CONTACT_LOSS_TIME,
    FAILURES,
    AMPLITUDES,
    HISTORY,
    RESULT_COUNT
};

/* A sampled loop: what happens at an event, to the memory of the runs of a group and their commands
 * (sweeps/native_integration.py); numbers of commands and of marks in time up to which amplitudes
 * are compared (integrator/inputs.py), and the place of the failures in the memory. Commands are
 * states that do not change between events, in each block. NULL without a loop. */
typedef struct {
    void (*process)(const void *const *numbers, int64_t event, double time, Register *memory,
                    const Register *state, Register *commands);
    int64_t commands, marks, failures;
} Loop;

/* Numbers of the vehicles of a load, all alike: first wheel, and wheels and states of each. */
enum { FIRST_WHEEL, WHEELS, STATES, COUNT, VEHICLE_NUMBERS };

/* Motions of the beam under a wheel; the last two are those that springs of vehicles need. */
enum { ACCELERATION, DEFLECTION, VELOCITY, MOTIONS };

/* Motions of the profile under a wheel, in the order of SURFACE: (step, wheel, motion, path node,
 * run). */
enum { HEIGHT, HEIGHT_RATE, HEIGHT_SECOND_RATE, SURFACE_MOTIONS };

/* A step and its matrices, stored by columns: contact response (state, row), contact compliance
 * (row, row), both of each motion, force response (row, state), sample rows (state, row and end,
 * sample). Rows are the Gauss nodes of all loads on the beam; the forces of the first are
 * prescribed, and they have no contact response and compliance. Outputs that follow forces at once use
 * those at the ends of the step, too, two for each load: end response (end, state, load) and
 * compliance (end, load, load). */
typedef struct {
    int64_t number;        /* among all steps of the task */
    int64_t event, sample; /* at its start, -1 for none */
    int panel, kind, mark, loads, prescribed, rows, ends;
    double start, length;
    const double *transition;
    int64_t *load_numbers;
    double *contact_response[MOTIONS], *contact_compliance[MOTIONS], *force_response, *sample_rows;
    double *end_response, *end_compliance;
} Step;

/* Runs that fill a register; contact forces follow the state in memory, then those at the ends of
 * the step. Vehicles: their states, the forces q of the beam on the springs of the rows, these per
 * contact force, and those of the profile on the springs of all wheels. */
typedef struct {
    ptrdiff_t first;
    int count;
    Register *state, *next_state, *matrix, *end_forces;
    Register *vehicle_state, *next_vehicle_state, *surface, *impedance, *profile;
    Register *samples; /* (step, sample, position) */
    /* (step, position): largest of the samples, and bound of the curve between them */
    Register *sample_peak, *peak_bound;
    /* Of a loop: memory, states without the commands, these, amplitudes squared by marks. */
    Register *memory, *plant_state, *commands, *amplitudes;
} Group;

typedef struct {
    /* Numbers of each; modes are those of a block. */
    int panels, lengths, blocks, block_size, modes, segments, terms, pieces, max_loads, loads, positions;
    int influence_pieces, influence_terms;
    int states, all_modes, sample_count, columns;
    /* The last wheels, whose vehicles are absorbers; entries of the input matrices of all vehicles. */
    int absorbers, input_entries;
    /* Loads with vehicles and their VEHICLE_NUMBERS; motions that are needed, states of all
     * vehicles, the largest numbers of one, registers of the propagators of all loads. */
    int groups_of_vehicles, motions, vehicle_states, most_states, most_wheels, vehicle_registers;
    const int64_t *vehicles;
    const Loop *loop;
    int commands, marks, memory_size;
    int has_surface, has_forces, has_initial;
    /* Panels share step lengths; outputs of a history; no later step can raise a peak. */
    int shares_lengths, history_rows, peaks_final;
    int64_t task, samples; /* number of the task; samples of its history */
    /* Runs with forces over time, a surface, vehicles of their own: all, or one for all. */
    int64_t forced_runs, surface_runs, vehicle_runs;
    ptrdiff_t batch_size;
    const double *inputs[ARGUMENT_COUNT];
    double *const *outputs;
    /* Of the task: series of mode shapes and their derivatives. */
    double *series;
    /* Whether the force of each wheel is prescribed: it has neither mass nor spring. */
    int64_t *prescribed;
    /* Of each step length: propagators, with nodes, forces or samples as the last axis. */
    double *node_transition, *node_force_response, *transition, *force_response, *sample_rows,
        *sample_response;
    int64_t *length_used;
    /* Exponential of a block, for several fractions of steps at once. */
    double *scale;
    Register *block_matrix, *input_matrix, *series_sums, *product, *exponential,
        *doubled_exponential, *phi, *doubled_phi, *weights, *vehicle_scale;
    /* Of a step: mode shapes and contact rows at the Gauss nodes. */
    double *shape, *contact_rows;
    Register *acceleration, *shape_sums, *chebyshev;
    /* Of a group of runs: roots of the energies of the blocks. */
    Register *root_energy;
    /* Of each run: state, running peaks, smallest contact forces; whether it is finite. */
    double *state, *peak, *peak_samples, *peak_step_start, *peak_step_length, *lowest_force,
        *contact_loss_time, *finite, *vehicle_state, *memory, *amplitudes;
    /* Propagators of vehicles, and the length of steps that they are for. */
    Register *vehicle_propagators;
    int64_t *vehicle_kind;
    double first_vehicle_entry, last_vehicle_exit; /* s */
    Group groups[INTERLEAVED_GROUPS];
    Step steps[CHUNK_STEPS];
    double end_slopes[2 * PEAK_POINTS]; /* weights of the samples in the slopes at both ends */
} Workspace;

static int padded_size(int count) { return (count + PADDING - 1) / PADDING * PADDING; }

/* Sizes of the matrices of a step length, in doubles. */
static size_t node_transition_size(const Workspace *w) {
    return (size_t)w->states * w->block_size * PADDED_NODES;
}
static size_t force_response_size(const Workspace *w) {
    return (size_t)w->states * w->modes * PADDED_NODES;
}
static size_t node_force_response_size(const Workspace *w) {
    return NODES * force_response_size(w);
}
static size_t transition_size(const Workspace *w) { return (size_t)w->states * w->block_size; }
static size_t sample_rows_size(const Workspace *w) { return (size_t)w->states * w->sample_count; }
static size_t sample_response_size(const Workspace *w) {
    return (size_t)NODES * w->all_modes * padded_size(w->sample_count);
}

/* How many propagators of vehicles are kept: of each length, or of each group of runs. */
static size_t vehicle_propagator_count(const Workspace *w) {
    if (w->vehicle_runs == 1) return (size_t)w->lengths;
    return (size_t)(w->batch_size + REGISTER_WIDTH - 1) / REGISTER_WIDTH;
}

/* Next part of the workspace, aligned to registers. */
static void *allocate(uintptr_t start, size_t *used, size_t numbers) {
    void *part = (void *)(start + *used);
    *used += (8 * numbers + sizeof(Register) - 1) & -sizeof(Register);
    return part;
}

/* Set the pointers into the workspace; its size in bytes. */
static size_t partition_workspace(Workspace *w, uintptr_t start) {
    size_t used = 0, batch_size = (size_t)w->batch_size, lengths = (size_t)w->lengths,
           block_size = (size_t)w->block_size;
    size_t loads = (size_t)w->max_loads, rows = loads * NODES, ends = 2 * loads;
    size_t states = (size_t)w->states, sample_count = (size_t)w->sample_count;
    size_t positions = (size_t)w->positions, all_modes = (size_t)w->all_modes,
           modes = (size_t)w->modes;
    w->series = allocate(start, &used, (size_t)w->segments * w->terms * w->columns);
    w->prescribed = allocate(start, &used, (size_t)w->loads);
    w->node_transition = allocate(start, &used, lengths * node_transition_size(w));
    w->node_force_response = allocate(start, &used, lengths * node_force_response_size(w));
    w->transition = allocate(start, &used, lengths * transition_size(w));
    w->force_response = allocate(start, &used, lengths * force_response_size(w));
    w->sample_rows = allocate(start, &used, lengths * sample_rows_size(w));
    w->sample_response = allocate(start, &used, lengths * sample_response_size(w));
    w->length_used = allocate(start, &used, lengths);
    w->scale = allocate(start, &used, block_size);
    const size_t side = block_size > (size_t)w->most_states ? block_size : (size_t)w->most_states,
                 forces = modes > (size_t)w->most_wheels ? modes : (size_t)w->most_wheels;
    w->block_matrix = allocate(start, &used, side * side * REGISTER_WIDTH);
    w->input_matrix = allocate(start, &used, side * forces * REGISTER_WIDTH);
    w->series_sums = allocate(start, &used, side * (side + forces) * REGISTER_WIDTH);
    w->product = allocate(start, &used, side * (side + forces) * REGISTER_WIDTH);
    w->exponential = allocate(start, &used, side * side * REGISTER_WIDTH);
    w->doubled_exponential = allocate(start, &used, side * side * REGISTER_WIDTH);
    w->phi = allocate(start, &used, side * NODES * forces * REGISTER_WIDTH);
    w->doubled_phi = allocate(start, &used, side * NODES * forces * REGISTER_WIDTH);
    w->vehicle_scale = allocate(start, &used, (size_t)w->most_states * REGISTER_WIDTH);
    w->weights = allocate(start, &used, NODES * NODES * REGISTER_WIDTH);
    w->shape = allocate(start, &used, (size_t)w->max_loads * all_modes * PADDED_NODES);
    w->contact_rows =
        allocate(start, &used, (size_t)(w->motions * w->max_loads) * states * PADDED_NODES);
    w->acceleration = allocate(start, &used, all_modes * REGISTER_WIDTH);
    w->shape_sums = allocate(start, &used, (size_t)2 * w->columns * REGISTER_WIDTH);
    w->chebyshev = allocate(start, &used, (size_t)w->terms * REGISTER_WIDTH);
    w->root_energy = allocate(start, &used, (size_t)w->blocks * REGISTER_WIDTH);
    w->state = allocate(start, &used, states * batch_size);
    w->peak = allocate(start, &used, positions * batch_size);
    w->peak_samples = allocate(start, &used, PEAK_POINTS * positions * batch_size);
    w->peak_step_start = allocate(start, &used, positions * batch_size);
    w->peak_step_length = allocate(start, &used, positions * batch_size);
    w->lowest_force = allocate(start, &used, (size_t)w->loads * batch_size);
    w->contact_loss_time = allocate(start, &used, (size_t)w->loads * batch_size);
    w->finite = allocate(start, &used, batch_size);
    w->memory = allocate(start, &used, (size_t)w->memory_size * batch_size);
    w->amplitudes = allocate(start, &used, (size_t)w->marks * batch_size);
    const size_t propagators = vehicle_propagator_count(w);
    w->vehicle_state = allocate(start, &used, (size_t)w->vehicle_states * batch_size);
    w->vehicle_propagators =
        allocate(start, &used, propagators * (size_t)w->vehicle_registers * REGISTER_WIDTH);
    w->vehicle_kind = allocate(start, &used, propagators);
    for (int k = 0; k < INTERLEAVED_GROUPS; k++) {
        Group *g = w->groups + k;
        g->state = allocate(start, &used, (states + rows + ends) * REGISTER_WIDTH);
        g->next_state = allocate(start, &used, (states + rows + ends) * REGISTER_WIDTH);
        g->end_forces = allocate(start, &used, loads * REGISTER_WIDTH);
        g->matrix = allocate(start, &used, rows * rows * REGISTER_WIDTH);
        g->samples = allocate(start, &used, CHUNK_STEPS * sample_count * REGISTER_WIDTH);
        g->sample_peak = allocate(start, &used, CHUNK_STEPS * positions * REGISTER_WIDTH);
        g->peak_bound = allocate(start, &used, CHUNK_STEPS * positions * REGISTER_WIDTH);
        g->memory = allocate(start, &used, (size_t)w->memory_size * REGISTER_WIDTH);
        g->plant_state = allocate(start, &used, states * REGISTER_WIDTH);
        g->commands = allocate(start, &used, (size_t)w->commands * REGISTER_WIDTH);
        g->amplitudes = allocate(start, &used, (size_t)w->marks * REGISTER_WIDTH);
        if (!w->groups_of_vehicles) continue;
        g->vehicle_state = allocate(start, &used, (size_t)w->vehicle_states * REGISTER_WIDTH);
        g->next_vehicle_state = allocate(start, &used, (size_t)w->vehicle_states * REGISTER_WIDTH);
        g->surface = allocate(start, &used, MOTIONS * rows * REGISTER_WIDTH);
        g->impedance = allocate(start, &used, rows * rows * REGISTER_WIDTH);
        g->profile = allocate(start, &used, (size_t)w->loads * NODES * REGISTER_WIDTH);
    }
    for (int t = 0; t < CHUNK_STEPS; t++) {
        Step *step = w->steps + t;
        step->load_numbers = allocate(start, &used, (size_t)w->max_loads);
        for (int motion = 0; motion < w->motions; motion++) {
            step->contact_response[motion] = allocate(start, &used, rows * states);
            step->contact_compliance[motion] = allocate(start, &used, rows * rows);
        }
        step->force_response = allocate(start, &used, rows * states);
        step->sample_rows = allocate(start, &used, (states + rows + ends) * sample_count);
        step->end_response = allocate(start, &used, ends * states);
        step->end_compliance = allocate(start, &used, ends * loads);
    }
    return used;
}

/* Registers of the propagators of one vehicle: transition (state, state), spring states (wheel,
 * node, state), input (wheel, state, node), spring surface (wheel, wheel, node, node). */
static int vehicle_registers(int states, int wheels) {
    return (states + wheels * NODES) * (states + wheels * NODES);
}

/* Sizes that follow from others. */
static void derive_sizes(Workspace *w) {
    w->states = w->blocks * w->block_size, w->all_modes = w->blocks * w->modes;
    w->sample_count = PEAK_POINTS * w->positions, w->columns = 3 * w->all_modes;
    w->motions = w->groups_of_vehicles ? MOTIONS : 1;
    if (w->loop) w->commands = (int)w->loop->commands, w->marks = (int)w->loop->marks;
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        const int states = (int)numbers[STATES], wheels = (int)numbers[WHEELS];
        w->vehicle_states += (int)numbers[COUNT] * states;
        w->vehicle_registers += vehicle_registers(states, wheels);
        if (states > w->most_states) w->most_states = states;
        if (wheels > w->most_wheels) w->most_wheels = wheels;
    }
}

/* Arguments of a task. */
static void set_inputs(Workspace *w, const Array *arguments, int64_t task) {
    for (int i = 0; i < ARGUMENT_COUNT; i++) {
        const Array *array = arguments + i;
        int64_t bytes = i == MASK || i == LOADS_ON_BEAM ? 1 : 8;
        for (int axis = 1; axis < MAX_AXES; axis++) bytes *= array->sizes[axis];
        int64_t away = array->sizes[0] > 1 ? task * bytes : 0;
        w->inputs[i] = (const double *)((const char *)array->numbers + away);
    }
}

/* Number of the sample at the start of a panel, or at the end of the last; -1 for none. */
static int64_t sample_of_panel(const Workspace *w, int panel) {
    return w->history_rows ? ((const int64_t *)w->inputs[SAMPLES])[panel] : -1;
}

static int64_t panel_steps(const Workspace *w, int panel) {
    return ((const int64_t *)w->inputs[STEP_COUNTS])[panel];
}

/* Index of the length of the steps of a panel: each has its own, or they share some. */
static int length_of_panel(const Workspace *w, int panel) {
    return w->shares_lengths ? (int)((const int64_t *)w->inputs[LENGTHS_OF_PANELS])[panel] : panel;
}

/* Numbers of a group of runs, from those of all runs, or of one for all. */
static inline Register of_group(const double *numbers, int64_t runs, const Group *g) {
    return runs == 1 ? broadcast(*numbers) : load(numbers + g->first, g->count);
}

/* Motion of the profile under a wheel at a path node. */
static inline Register profile_motion(const Workspace *w, const Step *step, const Group *g,
                                      int64_t wheel, int motion, int node) {
    const int64_t of_wheel = (step->number * w->loads + wheel) * SURFACE_MOTIONS + motion;
    return of_group(w->inputs[SURFACE] + (of_wheel * PATH_NODES + node) * w->surface_runs,
                    w->surface_runs, g);
}

/* Number of runs of the group that begins with the run `first`. */
static int runs_from(const Workspace *w, ptrdiff_t first) {
    const ptrdiff_t left = w->batch_size - first;
    return left < REGISTER_WIDTH ? (int)left : REGISTER_WIDTH;
}
