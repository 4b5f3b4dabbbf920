/* Where the propagators of vehicles are in the workspace. */

#pragma once

#include "workspace.h"

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

/* Number of the propagators of a step: a group of runs has its own, or all share those of its
 * length. */
static ptrdiff_t propagators_of(const Workspace *w, const Step *step, const Group *g) {
    return w->vehicle_runs == 1 ? step->kind : g->first / REGISTER_WIDTH;
}

/* Propagators of the vehicles of all loads for a group of runs in a step. */
static Register *vehicles_of(const Workspace *w, const Step *step, const Group *g) {
    return w->vehicle_propagators + propagators_of(w, step, g) * w->vehicle_registers;
}
