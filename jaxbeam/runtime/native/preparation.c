/* What is computed before runs are advanced: a third of the code, which another compiler compiles
 * meanwhile. */

#include "preparation.h"

#include "propagators.h"
#include "step_matrices.h"
#include "vehicle_propagators.h"

void prepare_task(Workspace *w) {
    shape_series(w);
    compute_propagators(w);
}

void prepare_step(const Workspace *w, const Step *step) { step_matrices(w, step); }

void prepare_vehicles(Workspace *w, const Step *step, const Group *g) {
    vehicle_propagators(w, step, g);
}
