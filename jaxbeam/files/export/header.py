"""Gains as a C header: arrays, and the functions `jaxbeam_command` and `jaxbeam_estimate`."""

import json
import math
from typing import Any

import numpy as np

from jaxbeam.files.export.gains import ARRAYS, Gains


def c_header(gains: Gains, metadata: dict[str, Any]) -> str:
    """Text of a C header with the gains, and the metadata in a comment at its top.

    Its functions are those of `Gains.command` and `Gains.estimate`.
    """
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
    texts = [_c_array(name, numbers) for name, numbers in arrays.items() if numbers.size]
    return "\n".join([f"/* {comment} */", *defines, *texts, C_FUNCTIONS])


def _c_array(name: str, numbers: np.ndarray) -> str:
    values = ", ".join(repr(float(number)) for number in np.ravel(numbers))
    return f"static const double jaxbeam_{name}[] = {{{values}}};"


C_FUNCTIONS = """
#ifdef JAXBEAM_FADE
#include <math.h>
#endif

/* Index of the last point of a grid that is not above a value, and the fraction to the next. */
static inline int jaxbeam_index(const double *grid, int count, double value, double *fraction)
{
    int i = 0;
    *fraction = 0.0;
    while (i + 1 < count && grid[i + 1] <= value) i++;
    if (i + 1 < count && value > grid[i]) *fraction = (value - grid[i]) / (grid[i + 1] - grid[i]);
    return i;
}

/* Two designs of a grid and their weights, for the interpolation at a value. */
static inline void jaxbeam_designs(
    const double *grid, int count, double value, int design[2], double weight[2])
{
    double fraction, distance, smallest = -1.0;
    int i = jaxbeam_index(grid, count, value, &fraction);
    design[0] = i;
    design[1] = i + 1 < count ? i + 1 : i;
    weight[0] = 1.0 - fraction;
    weight[1] = fraction;
    if (!JAXBEAM_NEAREST) return;
    weight[0] = 1.0;
    weight[1] = 0.0;
    for (i = 0; i < count; i++) {
        distance = value > grid[i] ? value - grid[i] : grid[i] - value;
        if (smallest >= 0.0 && distance >= smallest) continue;
        smallest = distance;
        design[0] = design[1] = i;
    }
}

/* Commands for a state at a share of the crossing (negative before the entry, 1 or more after the
   exit, which was since_exit s ago), for a load of this mass (kg) and speed (m/s). Results agree
   with Gains.command of jaxbeam to the last bit if compiled with -ffp-contract=off. */
static inline void jaxbeam_command(double mass, double speed, double share, double since_exit,
                                   const double *state, double *command)
{
    const int size = JAXBEAM_ACTUATORS * JAXBEAM_COLUMNS;
    double mass_weight[2], speed_weight[2], fraction, decay = 1.0;
    int mass_index[2], speed_index[2], point, next, after_exit, a, c, i, j, k, design;
    jaxbeam_designs(jaxbeam_masses, JAXBEAM_MASSES, mass, mass_index, mass_weight);
    jaxbeam_designs(jaxbeam_speeds, JAXBEAM_SPEEDS, speed, speed_index, speed_weight);
    point = jaxbeam_index(jaxbeam_shares, JAXBEAM_POINTS, share, &fraction);
    next = point + 1 < JAXBEAM_POINTS ? point + 1 : point;
    after_exit = share >= 1.0 && JAXBEAM_POINTS > 1;
#ifdef JAXBEAM_FADE
    if (after_exit) decay = exp(-since_exit / JAXBEAM_FADE);
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
                    double low, value;
                    design = mass_index[i] * JAXBEAM_SPEEDS + speed_index[j];
                    table = jaxbeam_table + design * JAXBEAM_POINTS * size;
                    rest = jaxbeam_rest + design * size;
                    low = table[point * size + k];
                    value = low + fraction * (table[next * size + k] - low);
                    if (after_exit) value = decay * rest[k];
                    gain += mass_weight[i] * speed_weight[j] * value;
                }
            }
            command[a] -= gain * state[c];
        }
    }
}

#ifdef JAXBEAM_ESTIMATED
/* State estimate at a sample, in place of that at the previous sample, for the commands that acted
   until the previous sample and until this one, and the readings. Zero initially; the first states
   are those of the gains. */
static inline void jaxbeam_estimate(double *state, const double *previous_command,
                                    const double *current_command, const double *readings)
{
    const int size = JAXBEAM_ESTIMATED, inputs = JAXBEAM_ACTUATORS;
    const int width = size + 2 * inputs + JAXBEAM_READINGS;
    double prior[JAXBEAM_ESTIMATED], innovation[JAXBEAM_READINGS];
    const double *row;
    int i, j;
    for (i = 0; i < size; i++) {
        row = jaxbeam_estimator + i * width;
        prior[i] = 0.0;
        for (j = 0; j < size; j++) prior[i] += row[j] * state[j];
        for (j = 0; j < inputs; j++) prior[i] += row[size + j] * previous_command[j];
        for (j = 0; j < inputs; j++) prior[i] += row[size + inputs + j] * current_command[j];
    }
    for (i = 0; i < JAXBEAM_READINGS; i++) {
        row = jaxbeam_estimator + (size + i) * width;
        innovation[i] = readings[i] - row[size + 2 * inputs];
        for (j = 0; j < size; j++) innovation[i] -= row[j] * prior[j];
        for (j = 0; j < inputs; j++) innovation[i] -= row[size + inputs + j] * current_command[j];
    }
    for (i = 0; i < size; i++) {
        row = jaxbeam_estimator + i * width + size + 2 * inputs;
        state[i] = prior[i];
        for (j = 0; j < JAXBEAM_READINGS; j++) state[i] += row[j] * innovation[j];
    }
}
#endif
"""
