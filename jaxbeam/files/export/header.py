"""Gains as plain C: arrays, and a function that gives the commands."""

import json
import math
from typing import Any

import numpy as np

from jaxbeam.files.export.gains import ARRAYS, Gains


def c_header(gains: Gains, metadata: dict[str, Any]) -> str:
    """The text of a C header with the gains; `metadata` stands in a comment at its top."""
    comment = json.dumps(metadata, indent=1).replace("*/", "* /")
    masses, speeds, points, actuators, columns = gains.table.shape
    test = gains.test_input
    macros = {"MASSES": masses, "SPEEDS": speeds, "POINTS": points}
    macros |= {"ACTUATORS": actuators, "COLUMNS": columns}
    macros |= {"NEAREST": int(gains.interpolation == "nearest")}
    macros |= {"FILTERS": len(gains.filters), "CHECK_CRC32": f"{gains.checksum}u"}
    if gains.estimator_size:
        macros |= {"ESTIMATED": gains.estimator_size, "READINGS": gains.reading_count}
    macros |= {"PERIOD": repr(gains.period), "CROSSING": repr(gains.crossing_time)}
    macros |= {"FADE": repr(gains.decay_time)} if math.isfinite(gains.decay_time) else {}
    macros |= {f"TEST_{name.upper()}": repr(test[name]) for name in ("share", "mass", "speed")}
    defines = [f"#define JAXBEAM_{name} {value}" for name, value in macros.items()]
    arrays = {name: getattr(gains, name) for name in ARRAYS}
    arrays |= {"test_command": gains.test_command, "test_estimate": gains.test_estimate}
    texts = [
        f"static const double jaxbeam_{name}[] = {{{', '.join(map(_c_number, np.ravel(numbers)))}}};"
        for name, numbers in arrays.items()
        if numbers.size
    ]
    return "\n".join([f"/* {comment} */", *defines, *texts, C_FUNCTIONS])


def _c_number(value: float) -> str:
    return repr(float(value))


C_FUNCTIONS = """
#ifdef JAXBEAM_FADE
#include <math.h>
#endif

/* The last point of a grid that is not above a value, and how far on to the next it is. */
static inline int jaxbeam_bracket(const double *grid, int count, double value, double *part)
{
    int i = 0;
    *part = 0.0;
    while (i + 1 < count && grid[i + 1] <= value) i++;
    if (i + 1 < count && value > grid[i]) *part = (value - grid[i]) / (grid[i + 1] - grid[i]);
    return i;
}

/* Two designs of a grid, and what each contributes at a value. */
static inline void jaxbeam_designs(
    const double *grid, int count, double value, int design[2], double weight[2])
{
    double part, far, least = -1.0;
    int i = jaxbeam_bracket(grid, count, value, &part);
    design[0] = i;
    design[1] = i + 1 < count ? i + 1 : i;
    weight[0] = 1.0 - part;
    weight[1] = part;
    if (!JAXBEAM_NEAREST) return;
    weight[0] = 1.0;
    weight[1] = 0.0;
    for (i = 0; i < count; i++) {
        far = value > grid[i] ? value - grid[i] : grid[i] - value;
        if (least >= 0.0 && far >= least) continue;
        least = far;
        design[0] = design[1] = i;
    }
}

/* Commands for a state at a share of the crossing, the exit having been since_exit s ago, and for
   the mass (kg) and speed (m/s) of the load. Compile with -ffp-contract=off for results that agree
   to the last bit. */
static inline void jaxbeam_command(double mass, double speed, double share, double since_exit,
                                   const double *state, double *command)
{
    const int size = JAXBEAM_ACTUATORS * JAXBEAM_COLUMNS;
    double masses[2], speeds[2], part, left = 1.0;
    int heavy[2], fast[2], point, next, over, a, c, i, j, k, which;
    jaxbeam_designs(jaxbeam_masses, JAXBEAM_MASSES, mass, heavy, masses);
    jaxbeam_designs(jaxbeam_speeds, JAXBEAM_SPEEDS, speed, fast, speeds);
    point = jaxbeam_bracket(jaxbeam_shares, JAXBEAM_POINTS, share, &part);
    next = point + 1 < JAXBEAM_POINTS ? point + 1 : point;
    over = share >= 1.0 && JAXBEAM_POINTS > 1;
#ifdef JAXBEAM_FADE
    if (over) left = exp(-since_exit / JAXBEAM_FADE);
#else
    (void)since_exit;
#endif
    for (a = 0; a < JAXBEAM_ACTUATORS; a++) {
        command[a] = 0.0;
        for (c = 0; c < JAXBEAM_COLUMNS && share >= 0.0; c++) {
            double gain = 0.0;
            k = a * JAXBEAM_COLUMNS + c;
            for (i = 0; i < 2; i++) {
                for (j = 0; j < 2; j++) {
                    const double *table, *rest;
                    double low, own;
                    which = heavy[i] * JAXBEAM_SPEEDS + fast[j];
                    table = jaxbeam_table + which * JAXBEAM_POINTS * size;
                    rest = jaxbeam_rest + which * size;
                    low = table[point * size + k];
                    own = low + part * (table[next * size + k] - low);
                    if (over) own = left * rest[k];
                    gain += masses[i] * speeds[j] * own;
                }
            }
            command[a] -= gain * state[c];
        }
    }
}

#ifdef JAXBEAM_ESTIMATED
/* The estimator's states from those at the tick before, for the commands that acted until then and
   until now, and the readings. Zero at the start; the first of them are those of the gains. */
static inline void jaxbeam_estimate(double *state, const double *before, const double *now,
                                    const double *readings)
{
    const int size = JAXBEAM_ESTIMATED, inputs = JAXBEAM_ACTUATORS;
    const int wide = size + 2 * inputs + JAXBEAM_READINGS;
    double prior[JAXBEAM_ESTIMATED], surprise[JAXBEAM_READINGS];
    const double *row;
    int i, j;
    for (i = 0; i < size; i++) {
        row = jaxbeam_estimator + i * wide;
        prior[i] = 0.0;
        for (j = 0; j < size; j++) prior[i] += row[j] * state[j];
        for (j = 0; j < inputs; j++) prior[i] += row[size + j] * before[j];
        for (j = 0; j < inputs; j++) prior[i] += row[size + inputs + j] * now[j];
    }
    for (i = 0; i < JAXBEAM_READINGS; i++) {
        row = jaxbeam_estimator + (size + i) * wide;
        surprise[i] = readings[i] - row[size + 2 * inputs];
        for (j = 0; j < size; j++) surprise[i] -= row[j] * prior[j];
        for (j = 0; j < inputs; j++) surprise[i] -= row[size + inputs + j] * now[j];
    }
    for (i = 0; i < size; i++) {
        row = jaxbeam_estimator + i * wide + size + 2 * inputs;
        state[i] = prior[i];
        for (j = 0; j < JAXBEAM_READINGS; j++) state[i] += row[j] * surprise[j];
    }
}
#endif
"""
