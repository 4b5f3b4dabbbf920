/* Propagators of vehicles, which the runs of a batch share or have of their own:
 * integrator/vehicles.py. */

#pragma once

#include "propagators.h"
#include "vehicle_layout.h"

/* Matrices of the vehicles of a load for some runs, with the runs as the last axis, or
 * one for all. */
typedef struct {
    const double *state, *input, *output;
} VehicleMatrices;

/* An entry of a matrix. */
static inline Register entry_of(const Workspace *w, const Group *g, const double *matrix,
                                int64_t entry) {
    return of_group(matrix + entry * w->vehicle_runs, w->vehicle_runs, g);
}

/* A number of one lane, or with `EACH` that of each. */
enum { EACH = -1 };
static inline Register in_lane(Register values, int lane) {
    return lane == EACH ? values : broadcast(values[lane]);
}

/* Part of a step at a fraction of it. */
static double part_of_step(const Workspace *w, int fraction) {
    return fraction < NODES ? w->inputs[GAUSS_NODES][fraction] : 1;
}

/* Add response to q at the nodes up to a fraction of a step, which is in a lane, and to the state
 * at its start. */
static void store_vehicle(Workspace *w, const VehicleMatrices *matrices, const Group *g,
                          const Vehicle *to, int states, int wheels, int fraction, double length,
                          int lane) {
    const int columns = NODES * wheels;
    const double part = part_of_step(w, fraction);
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
                    sum += weights[p] * in_lane(w->phi[i * columns + p * wheels + v], lane);
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
                    sum -= entry_of(w, g, matrices->output, u * states + i) *
                           response[i * wheels + v];
                to->press[((u * wheels + v) * NODES + fraction) * NODES + f] = sum;
            }
    }
    for (int j = 0; j < states; j++)
        if (fraction == NODES) {
            for (int i = 0; i < states; i++)
                to->transition[i * states + j] =
                    in_lane(w->exponential[i * states + j], lane) * (scale[j] / scale[i]);
        } else {
            for (int u = 0; u < wheels; u++) {
                Register sum = {0};
                for (int i = 0; i < states; i++)
                    sum += entry_of(w, g, matrices->output, u * states + i) *
                           in_lane(w->exponential[i * states + j], lane) * (scale[j] / scale[i]);
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
            sum += absolute(entry_of(w, g, matrix, i * states + j));
        largest = maximum(sum, largest);
    }
    for (int i = 0; i < states; i++)
        for (int l = 0; l < REGISTER_WIDTH; l++)
            w->vehicle_scale[i][l] = i < dofs ? sqrt(largest[l]) : 1;
}

/* Propagators of the vehicles of a group of runs for the steps of a length. Lanes are runs or, of
 * vehicles that all runs share, fractions of the step. */
static void vehicle_propagators(Workspace *w, const Step *step, const Group *g) {
    const int shared = w->vehicle_runs == 1, at_once = shared ? REGISTER_WIDTH : 1;
    int64_t *kind = w->vehicle_kind + propagators_of(w, step, g);
    if (*kind == step->kind) return;
    *kind = step->kind;
    VehicleMatrices m = {w->inputs[VEHICLE_STATE_MATRIX], w->inputs[VEHICLE_INPUT_MATRIX],
                         w->inputs[VEHICLE_OUTPUT_MATRIX]};
    Register *start = vehicles_of(w, step, g);
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        const int states = (int)numbers[STATES], wheels = (int)numbers[WHEELS];
        const Vehicle to = vehicle_at(start, states, wheels);
        const Register *scale = w->vehicle_scale;
        balance_vehicle(w, m.state, g, states);
        for (int i = 0; i < states; i++)
            for (int v = 0; v < wheels; v++)
                w->input_matrix[i * wheels + v] =
                    entry_of(w, g, m.input, i * wheels + v) * scale[i];
        for (int first = 0; first < STEP_FRACTIONS; first += at_once) {
            Register length;
            for (int l = 0; l < REGISTER_WIDTH; l++)
                length[l] = step->length * part_of_step(w, first + (shared ? l : 0));
            for (int i = 0; i < states; i++)
                for (int j = 0; j < states; j++)
                    w->block_matrix[i * states + j] =
                        entry_of(w, g, m.state, i * states + j) *
                        (scale[i] / scale[j]) * (length / (1 << DOUBLINGS));
            exponential_and_phi(w, states, wheels);
            for (int l = 0; l < at_once && first + l < STEP_FRACTIONS; l++)
                store_vehicle(w, &m, g, &to, states, wheels, first + l, step->length,
                              shared ? l : EACH);
        }
        m.state += states * states * w->vehicle_runs;
        m.input += states * wheels * w->vehicle_runs;
        m.output += states * wheels * w->vehicle_runs;
        start += vehicle_registers(states, wheels);
    }
}
