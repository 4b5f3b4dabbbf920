/* Contact forces of the loads on the beam in a step: integrator/step.py, integrator/peaks.py. */

#include "contact.h"

#include "peak_search.h"
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

void update_contact_minimum(const Workspace *w, const Step *step, const Group *g) {
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

/* Force on a wheel in addition to its weight at a path node. */
static inline Register force_at(const Workspace *w, const Step *step, const Group *g, int64_t wheel,
                                int node) {
    const int64_t at = (step->number * w->loads + wheel) * PATH_NODES + node;
    return of_group(w->inputs[LOAD_FORCES] + at * w->forced_runs, w->forced_runs, g);
}

/* Contact forces at the Gauss nodes of a step, for a number of loads that may be known when
 * compiling. */
static inline ALWAYS_INLINE void contact_forces(const Workspace *w, const Step *step,
                                                const Group *g, int loads, int prescribed,
                                                Register *matrix, Register *forces) {
    const int rows = loads * NODES;
    memset(forces, 0, (size_t)rows * sizeof *forces);
    add_product(forces, step->contact_response[ACCELERATION], rows, g->state, w->states);
    for (int s = 0; s < loads; s++) {
        const ptrdiff_t at = step->load_numbers[s] * w->batch_size + g->first;
        Register mass = load(w->inputs[INERTIA] + at, g->count),
                 weight = load(w->inputs[WEIGHT] + at, g->count);
        const int64_t wheel = step->load_numbers[s];
        for (int k = 0; k < NODES; k++) {
            const int i = s * NODES + k;
            if (w->has_surface)
                forces[i] += profile_motion(w, step, g, wheel, HEIGHT_SECOND_RATE, k);
            forces[i] = s < prescribed ? -weight : -(weight + mass * forces[i]);
            if (w->has_forces) forces[i] -= force_at(w, step, g, wheel, k);
            if (s < prescribed) continue;
            for (int j = 0; j < rows; j++)
                matrix[i * rows + j] = mass * step->contact_compliance[ACCELERATION][i * rows + j];
            matrix[i * rows + i] += 1;
        }
    }
    if (w->groups_of_vehicles) add_vehicles(w, step, g, loads, prescribed, matrix, forces);
    solve_contact_system(matrix, forces, rows, prescribed * NODES);
}

void solve_contact(const Workspace *w, const Step *step, const Group *g) {
    if (step->loads == 1 && !step->prescribed) { /* the matrix fits into registers */
        Register matrix[NODES * NODES], forces[NODES];
        contact_forces(w, step, g, 1, 0, matrix, forces);
        memcpy(g->state + w->states, forces, sizeof forces);
    } else {
        Register *forces = g->state + w->states;
        contact_forces(w, step, g, step->loads, step->prescribed, g->matrix, forces);
    }
}

void end_forces(const Workspace *w, const Step *step, const Group *g) {
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
                const int64_t wheel = step->load_numbers[s];
                if (w->has_surface)
                    right[s] += profile_motion(w, step, g, wheel, HEIGHT_SECOND_RATE, NODES + end);
                right[s] = -(load(w->inputs[WEIGHT] + at, g->count) + mass * right[s]);
                if (w->has_forces)
                    right[s] -= force_at(w, step, g, wheel, NODES + end);
                for (int q = 0; q < loads; q++)
                    matrix[s * loads + q] =
                        mass * step->end_compliance[(end * loads + s) * loads + q];
                matrix[s * loads + s] += 1;
            }
            solve_contact_system(matrix, right, loads, 0);
        }
        for (int s = 0; s < loads; s++) found[2 * s + end] = right[s];
    }
}
