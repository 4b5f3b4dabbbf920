/* Vehicles: integrator/vehicles.py. Their springs press on the beam with
 * s = S q - O z, from the forces q = k y + c y' of beam and profile at the nodes and their states z
 * at the start of a step. Blocks of S and O belong to wheels. */

#pragma once

#include "matrices.h"
#include "vehicle_layout.h"

/* Index of a wheel of a vehicle in a step, below zero for wheels of others. */
static inline int64_t wheel_of(const Step *step, int s, int64_t first, int wheels) {
    const int64_t wheel = step->load_numbers[s] - first;
    return wheel < wheels ? wheel : -1; /* wheels before the first are below zero, too */
}

int vehicles_move(const Workspace *w, const Step *step) {
    const double middle = step->start + step->length / 2;
    if ((w->has_surface || w->first_vehicle_entry < middle) && middle < w->last_vehicle_exit)
        return 1;
    /* Beside an exit, by rounding, a step of hardly any length has the wheel that leaves. */
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        for (int s = 0; s < step->loads; s++)
            if (wheel_of(step, s, numbers[FIRST_WHEEL], (int)(numbers[COUNT] * numbers[WHEELS])) >= 0)
                return 1;
    }
    return 0;
}

/* Forces of the profile on the springs of all wheels at the nodes. */
static void press_by_profile(const Workspace *w, const Step *step, const Group *g) {
    for (int wheel = 0; wheel < w->loads; wheel++) {
        const ptrdiff_t at = wheel * w->batch_size + g->first;
        const Register stiffness = load(w->inputs[STIFFNESS] + at, g->count),
                       damping = load(w->inputs[DAMPING] + at, g->count);
        for (int k = 0; k < NODES; k++)
            g->profile[wheel * NODES + k] =
                stiffness * profile_motion(w, step, g, wheel, HEIGHT, k) +
                damping * profile_motion(w, step, g, wheel, HEIGHT_RATE, k);
    }
}

/* Times of the first entry of a wheel of a vehicle and of the last exit. */
void set_vehicle_times(Workspace *w) {
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

/* Add the springs of vehicles to contact equations, `matrix` times forces = `right`. */
static inline ALWAYS_INLINE void add_vehicles(const Workspace *w, const Step *step, const Group *g,
                                              int loads, int prescribed, Register *matrix,
                                              Register *right) {
    const int rows = loads * NODES;
    Register *surface = g->surface, *deflection = surface + rows, *velocity = deflection + rows;
    memset(deflection, 0, 2 * (size_t)rows * sizeof *deflection);
    add_product(deflection, step->contact_response[DEFLECTION], rows, g->state, w->states);
    add_product(velocity, step->contact_response[VELOCITY], rows, g->state, w->states);
    for (int s = prescribed; s < loads; s++) {
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
    if (w->has_surface) press_by_profile(w, step, g);
    const Register *z = g->vehicle_state;
    Register *start = vehicles_of(w, step, g), pressed[NODES];
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        const int states = (int)numbers[STATES], wheels = (int)numbers[WHEELS];
        const Vehicle of = vehicle_at(start, states, wheels);
        start += vehicle_registers(states, wheels);
        for (int64_t i = 0; i < numbers[COUNT]; i++, z += states)
            for (int s = prescribed; s < loads; s++) {
                const int64_t first = numbers[FIRST_WHEEL] + i * wheels,
                              u = wheel_of(step, s, first, wheels);
                if (u < 0) continue;
                add_matrix_product(right + s * NODES, of.pull + u * NODES * states, NODES, z,
                                   states, 1);
                for (int t = prescribed; t < loads; t++) {
                    const int64_t v = wheel_of(step, t, first, wheels);
                    if (v < 0) continue;
                    const Register *press = of.press + (u * wheels + v) * NODES * NODES;
                    add_matrix_product(matrix + s * NODES * rows, press, NODES,
                                       g->impedance + t * NODES * rows, NODES, rows);
                    memset(pressed, 0, sizeof pressed);
                    add_matrix_product(pressed, press, NODES, surface + t * NODES, NODES, 1);
                    for (int k = 0; k < NODES; k++) right[s * NODES + k] -= pressed[k];
                }
                if (!w->has_surface) continue;
                memset(pressed, 0, sizeof pressed);
                for (int v = 0; v < wheels; v++)
                    add_matrix_product(pressed, of.press + (u * wheels + v) * NODES * NODES, NODES,
                                       g->profile + (first + v) * NODES, NODES, 1);
                for (int k = 0; k < NODES; k++) right[s * NODES + k] -= pressed[k];
            }
    }
}

/* States of vehicles at the end of a step; its contact forces follow the state of the beam. */
void propagate_vehicles(const Workspace *w, const Step *step, Group *g) {
    const int rows = step->rows, prescribed = step->prescribed * NODES;
    const Register *z = g->vehicle_state;
    Register *next = g->next_vehicle_state, *surface = g->surface, *start = vehicles_of(w, step, g);
    memset(next, 0, (size_t)w->vehicle_states * sizeof *next);
    if (rows)
        add_matrix_product(surface + prescribed, g->impedance + prescribed * rows,
                           rows - prescribed, g->state + w->states, rows, 1);
    else if (w->has_surface)
        press_by_profile(w, step, g); /* which no contact forces needed */
    for (int group = 0; group < w->groups_of_vehicles; group++) {
        const int64_t *numbers = w->vehicles + group * VEHICLE_NUMBERS;
        const int states = (int)numbers[STATES], wheels = (int)numbers[WHEELS];
        const Vehicle of = vehicle_at(start, states, wheels);
        start += vehicle_registers(states, wheels);
        for (int64_t i = 0; i < numbers[COUNT]; i++, z += states, next += states) {
            add_matrix_product(next, of.transition, states, z, states, 1);
            for (int s = step->prescribed; s < step->loads; s++) {
                const int64_t v = wheel_of(step, s, numbers[FIRST_WHEEL] + i * wheels, wheels);
                if (v < 0) continue;
                add_matrix_product(next, of.input + v * states * NODES, states, surface + s * NODES,
                                   NODES, 1);
            }
            for (int v = 0; w->has_surface && v < wheels; v++)
                add_matrix_product(next, of.input + v * states * NODES, states,
                                   g->profile + (numbers[FIRST_WHEEL] + i * wheels + v) * NODES,
                                   NODES, 1);
        }
    }
    Register *former = g->vehicle_state;
    g->vehicle_state = g->next_vehicle_state, g->next_vehicle_state = former;
}
