/* Vehicles on the beam: integrator/vehicles/propagators.py and steps.py, without a profile. Their
 * springs press on the beam with s = S q - O z, from the forces q = k y + c y' of the beam at the
 * nodes and their states z at the start of a step. Blocks of S and O belong to wheels. */

#pragma once

#include "propagators.h"

/* Propagators of a vehicle: z at the end is T z + N q; `pull` is O. */
typedef struct {
    Register *transition, *pull, *input, *press;
} Vehicle;

static Vehicle vehicle_at(Register *start, int states, int wheels) {
    const int rows = wheels * NODES;
    Vehicle vehicle = {start};
    vehicle.pull = vehicle.transition + states * states;
    vehicle.input = vehicle.pull + rows * states;
    vehicle.press = vehicle.input + states * rows;
    return vehicle;
}

/* Propagators of the vehicles of all loads for a group of runs. */
static Register *vehicles_of(const Workspace *w, const Group *g) {
    return w->vehicle_propagators + g->first / REGISTER_WIDTH * w->vehicle_registers;
}

/* Whether a vehicle is between its entry and its exit in a step; others are at rest or do not
 * return. */
static int vehicles_move(const Workspace *w, const Step *step) {
    const double middle = step->start + step->length / 2;
    return w->first_vehicle_entry < middle && middle < w->last_vehicle_exit;
}

/* Times of the first entry of a wheel of a vehicle and of the last exit. */
static void set_vehicle_times(Workspace *w) {
    w->first_vehicle_entry = INFINITY, w->last_vehicle_exit = -INFINITY;
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        const double *interval = w->inputs[ON_BEAM_INTERVALS] + 2 * numbers[FIRST_WHEEL];
        for (int64_t i = 0; i < numbers[COUNT] * numbers[WHEELS]; i++, interval += 2) {
            w->first_vehicle_entry = fmin(w->first_vehicle_entry, interval[0]);
            w->last_vehicle_exit = fmax(w->last_vehicle_exit, interval[1]);
        }
    }
}

/* Matrices of the vehicles of a load for some runs, with the runs as the last axis. */
typedef struct {
    const double *state, *input, *output;
} VehicleMatrices;

/* Add response to q at the nodes up to a fraction of a step, and to the state at its start. */
static void store_vehicle(Workspace *w, const VehicleMatrices *matrices, const Group *g,
                          const Vehicle *to, int states, int wheels, int fraction, double length) {
    const int columns = NODES * wheels;
    const double part = fraction < NODES ? w->inputs[GAUSS_NODES][fraction] : 1;
    Register *response = w->product, *scale = w->vehicle_scale; /* response: (state, wheel) */
    for (int f = 0; f < NODES; f++) {
        double weights[NODES], power = length * part;
        for (int p = 0; p < NODES; p++, power *= part)
            weights[p] = w->inputs[LAGRANGE_COEFFICIENTS][f * NODES + p] / INVERSE_FACTORIAL[p] *
                         power;
        for (int i = 0; i < states; i++)
            for (int v = 0; v < wheels; v++) {
                Register sum = {0};
                for (int p = 0; p < NODES; p++)
                    sum += weights[p] * w->phi[i * columns + p * wheels + v];
                response[i * wheels + v] = sum / scale[i];
            }
        if (fraction == NODES) {
            for (int v = 0; v < wheels; v++)
                for (int i = 0; i < states; i++)
                    to->input[(v * states + i) * NODES + f] = response[i * wheels + v];
            continue;
        }
        for (int u = 0; u < wheels; u++)
            for (int v = 0; v < wheels; v++) {
                Register sum = broadcast(u == v && f == fraction);
                for (int i = 0; i < states; i++)
                    sum -= load(matrices->output + (u * states + i) * w->batch_size, g->count) *
                           response[i * wheels + v];
                to->press[((u * wheels + v) * NODES + fraction) * NODES + f] = sum;
            }
    }
    for (int j = 0; j < states; j++)
        if (fraction == NODES) {
            for (int i = 0; i < states; i++)
                to->transition[i * states + j] =
                    w->exponential[i * states + j] * (scale[j] / scale[i]);
        } else {
            for (int u = 0; u < wheels; u++) {
                Register sum = {0};
                for (int i = 0; i < states; i++)
                    sum += load(matrices->output + (u * states + i) * w->batch_size, g->count) *
                           w->exponential[i * states + j] * (scale[j] / scale[i]);
                to->pull[(u * NODES + fraction) * states + j] = sum;
            }
        }
}

/* Scale of the states of vehicles that makes displacements and rates comparable. */
static void balance_vehicle(const Workspace *w, const double *matrix, const Group *g, int states) {
    const int dofs = states / 2;
    Register largest = {0};
    for (int i = dofs; i < states; i++) {
        Register sum = broadcast(1);
        for (int j = 0; j < dofs; j++)
            sum += absolute(load(matrix + (i * states + j) * w->batch_size, g->count));
        largest = maximum(sum, largest);
    }
    for (int i = 0; i < states; i++)
        for (int l = 0; l < REGISTER_WIDTH; l++)
            w->vehicle_scale[i][l] = i < dofs && l < g->count ? sqrt(largest[l]) : 1;
}

/* Propagators of the vehicles of a group of runs for the steps of a panel. */
static void vehicle_propagators(Workspace *w, const Step *step, const Group *g) {
    int64_t *panel = w->vehicle_panel + g->first / REGISTER_WIDTH;
    if (*panel == step->panel) return;
    *panel = step->panel;
    VehicleMatrices m = {w->inputs[VEHICLE_STATE_MATRIX] + g->first,
                         w->inputs[VEHICLE_INPUT_MATRIX] + g->first,
                         w->inputs[VEHICLE_OUTPUT_MATRIX] + g->first};
    Register *start = vehicles_of(w, g);
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        const int states = (int)numbers[STATES], wheels = (int)numbers[WHEELS];
        const Vehicle to = vehicle_at(start, states, wheels);
        const Register *scale = w->vehicle_scale;
        balance_vehicle(w, m.state, g, states);
        for (int i = 0; i < states; i++)
            for (int v = 0; v < wheels; v++)
                w->input_matrix[i * wheels + v] =
                    load(m.input + (i * wheels + v) * w->batch_size, g->count) * scale[i];
        for (int fraction = 0; fraction < STEP_FRACTIONS; fraction++) {
            const double part = fraction < NODES ? w->inputs[GAUSS_NODES][fraction] : 1;
            for (int i = 0; i < states; i++)
                for (int j = 0; j < states; j++)
                    w->block_matrix[i * states + j] =
                        load(m.state + (i * states + j) * w->batch_size, g->count) *
                        (scale[i] / scale[j]) * (step->length * part / (1 << DOUBLINGS));
            exponential_and_phi(w, states, wheels);
            store_vehicle(w, &m, g, &to, states, wheels, fraction, step->length);
        }
        m.state += states * states * w->batch_size;
        m.input += states * wheels * w->batch_size;
        m.output += states * wheels * w->batch_size;
        start += vehicle_registers(states, wheels);
    }
}

/* Index of a wheel of a vehicle in a step, below zero for wheels of others. */
static inline int64_t wheel_of(const Step *step, int s, int64_t first, int wheels) {
    const int64_t wheel = step->load_numbers[s] - first;
    return wheel < wheels ? wheel : -1; /* wheels before the first are below zero, too */
}

/* Add the springs of vehicles to contact equations, `matrix` times forces = `right`. */
static inline ALWAYS_INLINE void add_vehicles(const Workspace *w, const Step *step, const Group *g,
                                              int loads, Register *matrix, Register *right) {
    const int rows = loads * NODES;
    Register *surface = g->surface, *deflection = surface + rows, *velocity = deflection + rows;
    memset(deflection, 0, 2 * (size_t)rows * sizeof *deflection);
    add_product(deflection, step->contact_response[DEFLECTION], rows, g->state, w->states);
    add_product(velocity, step->contact_response[VELOCITY], rows, g->state, w->states);
    for (int s = 0; s < loads; s++) {
        const ptrdiff_t at = step->load_numbers[s] * w->batch_size + g->first;
        const Register stiffness = load(w->inputs[STIFFNESS] + at, g->count),
                       damping = load(w->inputs[DAMPING] + at, g->count);
        for (int i = s * NODES; i < (s + 1) * NODES; i++) {
            surface[i] = stiffness * deflection[i] + damping * velocity[i];
            for (int j = i * rows; j < (i + 1) * rows; j++)
                g->impedance[j] = stiffness * step->contact_compliance[DEFLECTION][j] +
                                  damping * step->contact_compliance[VELOCITY][j];
        }
    }
    const Register *z = g->vehicle_state;
    Register *start = vehicles_of(w, g), pressed[NODES];
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        const int states = (int)numbers[STATES], wheels = (int)numbers[WHEELS];
        const Vehicle of = vehicle_at(start, states, wheels);
        start += vehicle_registers(states, wheels);
        for (int64_t i = 0; i < numbers[COUNT]; i++, z += states)
            for (int s = 0; s < loads; s++) {
                const int64_t first = numbers[FIRST_WHEEL] + i * wheels,
                              u = wheel_of(step, s, first, wheels);
                if (u < 0) continue;
                add_matrix_product(right + s * NODES, of.pull + u * NODES * states, NODES, z,
                                   states, 1);
                for (int t = 0; t < loads; t++) {
                    const int64_t v = wheel_of(step, t, first, wheels);
                    if (v < 0) continue;
                    const Register *press = of.press + (u * wheels + v) * NODES * NODES;
                    add_matrix_product(matrix + s * NODES * rows, press, NODES,
                                       g->impedance + t * NODES * rows, NODES, rows);
                    memset(pressed, 0, sizeof pressed);
                    add_matrix_product(pressed, press, NODES, surface + t * NODES, NODES, 1);
                    for (int k = 0; k < NODES; k++) right[s * NODES + k] -= pressed[k];
                }
            }
    }
}

/* States of vehicles at the end of a step; its contact forces follow the state of the beam. */
static void propagate_vehicles(const Workspace *w, const Step *step, Group *g) {
    const int rows = step->rows;
    const Register *z = g->vehicle_state;
    Register *next = g->next_vehicle_state, *surface = g->surface, *start = vehicles_of(w, g);
    memset(next, 0, (size_t)w->vehicle_states * sizeof *next);
    if (rows)
        add_matrix_product(surface, g->impedance, rows, g->state + w->states, rows, 1);
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        const int states = (int)numbers[STATES], wheels = (int)numbers[WHEELS];
        const Vehicle of = vehicle_at(start, states, wheels);
        start += vehicle_registers(states, wheels);
        for (int64_t i = 0; i < numbers[COUNT]; i++, z += states, next += states) {
            add_matrix_product(next, of.transition, states, z, states, 1);
            for (int s = 0; s < step->loads; s++) {
                const int64_t v = wheel_of(step, s, numbers[FIRST_WHEEL] + i * wheels, wheels);
                if (v < 0) continue;
                add_matrix_product(next, of.input + v * states * NODES, states, surface + s * NODES,
                                   NODES, 1);
            }
        }
    }
    Register *former = g->vehicle_state;
    g->vehicle_state = g->next_vehicle_state, g->next_vehicle_state = former;
}
