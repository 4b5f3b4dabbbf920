/* Contact forces of the loads on the beam in a step, compiled beside the rest to save time:
 * contact.c. They follow the state of a group of runs in memory. */

#pragma once

#include "workspace.h"

#pragma GCC visibility push(hidden)

/* Contact forces at the Gauss nodes of a step. */
void solve_contact(const Workspace *w, const Step *step, const Group *g);

/* Smallest contact forces so far, and the first times at which they are tensile. */
void update_contact_minimum(const Workspace *w, const Step *step, const Group *g);

/* Contact forces at the ends of a step from the states there, before and after it. Those of
 * vehicles are extrapolated from the Gauss nodes: peaks/end_forces.py. */
void end_forces(const Workspace *w, const Step *step, const Group *g);

/* Times of the first entry of a wheel of a vehicle and of the last exit. */
void set_vehicle_times(Workspace *w);

/* Whether vehicles move in a step, and may yet press on the beam: between their first entry and
 * their last exit, on a profile from the start. */
int vehicles_move(const Workspace *w, const Step *step);

/* States of vehicles at the end of a step; its contact forces follow the state of the beam. */
void propagate_vehicles(const Workspace *w, const Step *step, Group *g);

#pragma GCC visibility pop
