/* Peaks of the curve through the samples of a step, for lanes side by side: what peaks.py does.

   The command line tells POINTS (looked at in a step, both ends among them), ROUNDS and REACH (of Newton's
   method in peaks.vertex), STARTS and CLIMBS (in peaks.find), SLACK (of numbers that are equal), NEAR and
   BESIDE_END (as in extremes.py). */

#pragma once

#include <math.h>

#include "native_lanes.h"

static inline Lanes value(const Lanes *coefficients, int terms, Lanes place) {
    Lanes sum = coefficients[terms - 1];
    for (int i = terms - 2; i >= 0; i--) sum = coefficients[i] + place * sum;
    return sum;
}

/* A polynomial in 2 c - 1 and its derivatives: coefficients, lowest power first. */
typedef struct {
    Lanes value[POINTS], slope[POINTS - 1], bend[POINTS - 2];
} Curve;

static inline Curve curve_through(const Lanes *samples, const double *through) {
    Curve curve = {0};
    add_product(curve.value, through, POINTS, samples, POINTS);
    for (int i = 1; i < POINTS; i++) curve.slope[i - 1] = i * curve.value[i];
    for (int i = 1; i < POINTS - 1; i++) curve.bend[i - 1] = i * curve.slope[i];
    return curve;
}

/* The size of a curve at a place. */
static inline Lanes size_at(const Curve *curve, Lanes place) {
    return absolute(value(curve->value, POINTS, place));
}

/* Where the curve is flat near a place, by rounds of Newton's method within reach. */
static inline Lanes climb(const Curve *curve, Lanes place, double within, int rounds) {
    Lanes reach = all(within);
    for (int r = 0; r < rounds; r++) {
        Lanes steep = value(curve->bend, POINTS - 2, place);
        Mask flat = steep == 0;
        Lanes step = value(curve->slope, POINTS - 1, place) / either(flat, all(1), steep);
        step = either(flat, all(0), less(greater(step, -reach), reach));
        place = less(greater(place - step, all(-1)), all(1));
    }
    return place;
}

/* Largest size of a value of the curve through samples, as peaks.vertex has it. */
static inline Lanes vertex(const Lanes *samples, const double *through, const double *points) {
    Lanes highest = absolute(samples[0]), place = all(-1);
    for (int p = 1; p < POINTS; p++) {
        Lanes size = absolute(samples[p]);
        Mask higher = size > highest;
        highest = either(higher, size, highest);
        place = either(higher, all(2 * points[p] - 1), place);
    }
    Curve curve = curve_through(samples, through);
    return greater(size_at(&curve, climb(&curve, place, REACH, ROUNDS)), highest);
}

/* What is not below the largest, but for rounding. */
static inline Mask as_large(Lanes size, Lanes largest) {
    return size >= largest - SLACK * absolute(largest);
}

/* Where the curve through samples is largest, as peaks.find has it. Only from places that are no lower than
   those beside them is it worth looking further. */
static inline Lanes find(const Curve *curve) {
    enum { PLACES = 2 * STARTS };
    Lanes places[PLACES], sizes[PLACES], largest = all(-INFINITY), place = all(-1);
    for (int k = 0; k < STARTS; k++) {
        places[k] = all(2.0 * k / (STARTS - 1) - 1);
        sizes[k] = size_at(curve, places[k]);
        largest = greater(sizes[k], largest);
    }
    for (int k = 0; k < STARTS; k++) {
        const int before = k ? k - 1 : 0, after = k < STARTS - 1 ? k + 1 : k, found = STARTS + k;
        places[found] = places[k], sizes[found] = sizes[k];
        if (!any((sizes[k] >= sizes[before]) & (sizes[k] >= sizes[after]))) continue;
        places[found] = climb(curve, places[k], 2.0 / STARTS, CLIMBS);
        sizes[found] = size_at(curve, places[found]);
        largest = greater(sizes[found], largest);
    }
    for (int k = 0; k < PLACES; k++)
        place = either(as_large(sizes[k], largest), greater(places[k], place), place);
    Lanes flat = climb(curve, place, 2.0 / STARTS, CLIMBS);
    Lanes found = size_at(curve, flat), before = size_at(curve, place);
    return either(as_large(found, greater(found, before)), flat, place);
}

/* How large a value between samples may be: bumps grow with the square of the gap, so that one beside the
   largest is small if that is an end. */
static inline Lanes most_within(Lanes first, Lanes last, Lanes highest) {
    Mask inner = (absolute(first) < highest) & (absolute(last) < highest);
    return highest + either(inner, all(NEAR - 1), all(BESIDE_END)) * highest;
}

/* Whether the curve through samples rises above all of them within the step: the largest is none of the ends,
   or it rises from there. `ends` are the rows of its slope at both ends. */
static inline Mask rises_within(const Lanes *samples, const double *ends, Lanes highest) {
    Mask within = ~(Mask){0};
    for (int end = 0; end < 2; end++, ends += POINTS) {
        Lanes there = samples[end * (POINTS - 1)], slope = {0};
        Mask top = absolute(there) >= highest;
        if (!any(top)) continue;
        for (int p = 0; p < POINTS; p++) slope += ends[p] * samples[p];
        slope = either(there < 0, -slope, slope); /* away from rest, whatever side that is */
        within &= ~top | (end ? slope < 0 : slope > 0);
    }
    return within;
}
