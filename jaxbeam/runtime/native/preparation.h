/* What is computed before runs are advanced, compiled beside the rest to save time: preparation.c. */

#pragma once

#include "workspace.h"

#pragma GCC visibility push(hidden)

/* Shapes and propagators of a task, which all its steps share. */
void prepare_task(Workspace *w);

/* Matrices of a step, which all runs of a task share. */
void prepare_step(const Workspace *w, const Step *step);

/* Propagators of the vehicles of a group of runs for the steps of a length. */
void prepare_vehicles(Workspace *w, const Step *step, const Group *g);

#pragma GCC visibility pop
