/* Where the loads are in a step, and what the contact law feels of the rig there: tables.follow. */

#pragma once

#include "native_work.h"

/* The mode shapes of all segments, (segment, term, derivative and mode), as Chebyshev series by position. */
static void shape_series(Work *w) {
    const int terms = w->terms, modes = w->all_modes, columns = w->columns;
    for (int s = 0; s < w->segments; s++) {
        const double half = (w->in[ENDS][s + 1] - w->in[ENDS][s]) / 2;
        double *series = w->series + (ptrdiff_t)s * terms * columns;
        for (int k = 0; k < terms; k++)
            memcpy(series + k * columns, w->in[SERIES] + (s * terms + k) * modes, 8 * (size_t)modes);
        for (int d = modes; d < columns; d += modes) {
            /* With T_k' as a sum of others: each coefficient from those above it. */
            double *here = series + d;
            memset(here + (terms - 1) * columns, 0, 8 * (size_t)modes);
            for (int k = terms - 2; k >= 0; k--)
                for (int m = 0; m < modes; m++) {
                    double above = k + 2 < terms ? here[(k + 2) * columns + m] : 0;
                    here[k * columns + m] = above + 2 * (k + 1) * here[(k + 1) * columns + m - modes];
                }
            for (int m = 0; m < modes; m++) here[m] /= 2;
        }
        for (int k = 0; k < terms; k++)
            for (int c = modes; c < columns; c++)
                series[k * columns + c] /= c < 2 * modes ? half : half * half;
    }
}

/* Mode shapes and their first two derivatives at some places, into the first half of the sums. */
static void shapes(const Work *w, Lanes x) {
    const double *ends = w->in[ENDS];
    const size_t size = (size_t)w->columns * sizeof(Lanes);
    Lanes *sums = w->sums, *some = w->sums + w->columns, *powers = w->powers;
    for (int s = 0; s < w->segments; s++) {
        Mask here = ~(Mask){0};
        if (s > 0) here &= x >= ends[s];
        if (s < w->segments - 1) here &= x < ends[s + 1];
        if (!any(here)) continue;
        Lanes local = 2 * (x - ends[s]) / (ends[s + 1] - ends[s]) - 1;
        powers[0] = all(1);
        if (w->terms > 1) powers[1] = local;
        for (int k = 2; k < w->terms; k++) /* by doubling, which keeps the digits */
            powers[k] = 2 * powers[k / 2] * powers[k - k / 2] - powers[k % 2];
        memset(some, 0, size);
        add_product(some, w->series + (ptrdiff_t)s * w->terms * w->columns, w->columns, powers, w->terms);
        for (int c = 0; c < w->columns; c++) sums[c] = either(here, some[c], sums[c]);
    }
}

/* Mode shapes at the places that are watched, and the deflection at each under a unit force there: it bounds
   what a given energy can do. Stiffnesses are eliminated; without one, the bound is infinite. */
static void sights(const Work *w, double *stiffness) {
    const int side = w->side, modes = w->modes;
    for (int place = 0; place < w->places; place++) {
        double *sight = w->sights + place * w->all_modes;
        shapes(w, all(w->in[PLACES][place]));
        for (int m = 0; m < w->all_modes; m++) sight[m] = w->sums[m][0];
        w->flexibility[place] = 0;
        for (int b = 0; b < w->blocks; b++) {
            const double *matrix = w->in[STATE_MATRIX] + (ptrdiff_t)b * side * side;
            double *row = stiffness;
            for (int i = 0; i < modes; i++, row += modes + 1) {
                for (int j = 0; j < modes; j++) row[j] = -matrix[(2 * i + 1) * side + 2 * j];
                row[modes] = sight[b * modes + i];
                for (int k = 0; k < i; k++) {
                    const double *above = stiffness + k * (modes + 1), factor = row[k] / above[k];
                    for (int j = k; j <= modes; j++) row[j] -= factor * above[j];
                }
                const double bent = row[modes] * row[modes] / row[i];
                w->flexibility[place] += row[i] > 0 ? bent : INFINITY;
            }
        }
    }
}

/* Position, speed and acceleration of a load. */
static void travel(const Work *w, int64_t load, double time, double *position, double *speed,
                   double *acceleration) {
    const double *since = w->in[SINCE] + load * w->pieces;
    int piece = 0;
    for (int beyond = w->pieces; beyond - piece > 1;) {
        int middle = (piece + beyond) / 2;
        if (since[middle] <= time) piece = middle;
        else beyond = middle;
    }
    const double *c = w->in[CUBICS] + (load * w->pieces + piece) * 4, t = time - since[piece];
    *position = c[0] + t * (c[1] + t * (c[2] + t * c[3]));
    *speed = c[1] + t * (2 * c[2] + t * 3 * c[3]);
    *acceleration = 2 * c[2] + t * 6 * c[3];
}

/* Shape (mode, node) and contact rows (state, node) at the loads of a step: dynamics.contact_rows. */
static void follow(const Work *w, const Step *step) {
    const int side = w->side, modes = w->modes, all_modes = w->all_modes;
    for (int s = 0; s < step->loads; s++) {
        double position[PADDED], speed[PADDED], acceleration[PADDED];
        for (int k = 0; k < PADDED; k++) {
            double time = step->start + step->span * w->in[GAUSS][k < NODES ? k : NODES - 1];
            travel(w, step->load[s], time, position + k, speed + k, acceleration + k);
        }
        for (int first = 0; first < NODES; first += WIDE) {
            const Lanes v = whole(speed + first), a = whole(acceleration + first);
            double *shape = w->shape + (ptrdiff_t)s * all_modes * PADDED + first;
            double *feels = w->feels + (ptrdiff_t)s * w->states * PADDED + first;
            shapes(w, whole(position + first));
            const Lanes *value = w->sums, *slope = value + all_modes, *bend = slope + all_modes;
            for (int m = 0; m < all_modes; m++) store(shape + m * PADDED, value[m], WIDE);
            for (int i = 0; i < w->states; i++) {
                const int b = i / side, j = i % side, m = b * modes + j / 2;
                const double *rates = w->in[STATE_MATRIX] + ((ptrdiff_t)b * side + 1) * side + j;
                Lanes row = {0};
                for (int n = 0; n < modes; n++) row += value[b * modes + n] * rates[2 * n * side];
                if (j < 2 * modes) row += j % 2 ? 2 * v * slope[m] : v * v * bend[m] + a * slope[m];
                store(feels + i * PADDED, row, WIDE);
            }
        }
    }
}
