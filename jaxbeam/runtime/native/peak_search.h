/* Peak of the polynomial through the samples of a step: numerics/peak_search.py, whose constants
 * have the same names. PEAK_POINTS samples include both ends; PEAK_MARGIN is that of
 * integrator/peaks.py, END_PEAK_MARGIN its equivalent beside an end. */

#pragma once

#include <math.h>

#include "constants.h"
#include "matrices.h"

static inline Register polynomial(const Register *coefficients, int terms, Register x) {
    Register sum = coefficients[terms - 1];
    for (int i = terms - 2; i >= 0; i--) sum = coefficients[i] + x * sum;
    return sum;
}

/* Polynomial in x = 2 c - 1, c the fraction of the step, and its first two derivatives:
 * coefficients, lowest power first. */
typedef struct {
    Register value[PEAK_POINTS], slope[PEAK_POINTS - 1], curvature[PEAK_POINTS - 2];
} Curve;

static inline Curve curve_through(const Register *samples, const double *interpolation) {
    Curve curve = {0};
    add_product(curve.value, interpolation, PEAK_POINTS, samples, PEAK_POINTS);
    for (int i = 1; i < PEAK_POINTS; i++) curve.slope[i - 1] = i * curve.value[i];
    for (int i = 1; i < PEAK_POINTS - 1; i++) curve.curvature[i - 1] = i * curve.slope[i];
    return curve;
}

/* Absolute value of a curve at x. */
static inline Register magnitude(const Curve *curve, Register x) {
    return absolute(polynomial(curve->value, PEAK_POINTS, x));
}

/* Stationary point near x by Newton's method with limited steps. */
static inline Register newton(const Curve *curve, Register x, double step_limit, int iterations) {
    Register limit = broadcast(step_limit);
    for (int r = 0; r < iterations; r++) {
        Register curvature = polynomial(curve->curvature, PEAK_POINTS - 2, x);
        Mask flat = curvature == 0;
        Register step =
            polynomial(curve->slope, PEAK_POINTS - 1, x) / choose(flat, broadcast(1), curvature);
        step = choose(flat, broadcast(0), minimum(maximum(step, -limit), limit));
        x = minimum(maximum(x - step, broadcast(-1)), broadcast(1));
    }
    return x;
}

/* Estimate of the largest absolute value of the curve through samples: `estimate_peak`. */
static inline Register estimate_peak(const Register *samples, const double *interpolation,
                                     const double *fractions) {
    Register highest = absolute(samples[0]), x = broadcast(-1);
    for (int p = 1; p < PEAK_POINTS; p++) {
        Register size = absolute(samples[p]);
        Mask higher = size > highest;
        highest = choose(higher, size, highest);
        x = choose(higher, broadcast(2 * fractions[p] - 1), x);
    }
    Curve curve = curve_through(samples, interpolation);
    return maximum(magnitude(&curve, newton(&curve, x, NEWTON_STEP_LIMIT, ESTIMATE_ITERATIONS)),
                   highest);
}

/* Equal to the largest but for rounding. */
static inline Mask is_largest(Register size, Register largest) {
    return size >= largest - TIE_TOLERANCE * absolute(largest);
}

/* Position of the largest absolute value: `locate_peak`. Newton's method starts only from local
 * maxima of the start points. */
static inline Register find_peak(const Curve *curve) {
    enum { CANDIDATES = 2 * START_POINTS };
    Register candidates[CANDIDATES], magnitudes[CANDIDATES];
    Register largest = broadcast(-INFINITY), x = broadcast(-1);
    for (int k = 0; k < START_POINTS; k++) {
        candidates[k] = broadcast(2.0 * k / (START_POINTS - 1) - 1);
        magnitudes[k] = magnitude(curve, candidates[k]);
        largest = maximum(magnitudes[k], largest);
    }
    for (int k = 0; k < START_POINTS; k++) {
        const int before = k ? k - 1 : 0, after = k < START_POINTS - 1 ? k + 1 : k,
                  found = START_POINTS + k;
        candidates[found] = candidates[k], magnitudes[found] = magnitudes[k];
        if (!any((magnitudes[k] >= magnitudes[before]) & (magnitudes[k] >= magnitudes[after])))
            continue;
        candidates[found] = newton(curve, candidates[k], 2.0 / START_POINTS, NEWTON_ITERATIONS);
        magnitudes[found] = magnitude(curve, candidates[found]);
        largest = maximum(magnitudes[found], largest);
    }
    for (int k = 0; k < CANDIDATES; k++)
        x = choose(is_largest(magnitudes[k], largest), maximum(candidates[k], x), x);
    Register flat = newton(curve, x, 2.0 / START_POINTS, NEWTON_ITERATIONS);
    Register found = magnitude(curve, flat), before = magnitude(curve, x);
    return choose(is_largest(found, maximum(found, before)), flat, x);
}

/* Upper bound of the curve. An excess over the samples grows with the square of the gap between
 * them, and the gaps beside the ends are small. */
static inline Register peak_bound_within(Register first, Register last, Register highest) {
    Mask inner = (absolute(first) < highest) & (absolute(last) < highest);
    return highest +
           choose(inner, broadcast(PEAK_MARGIN - 1), broadcast(END_PEAK_MARGIN)) * highest;
}

/* Whether the curve exceeds all samples: the largest is inside, or the curve rises from its end. */
static inline Mask peak_inside(const Register *samples, const double *end_slopes,
                               Register highest) {
    Mask inside = ~(Mask){0};
    for (int end = 0; end < 2; end++, end_slopes += PEAK_POINTS) {
        Register there = samples[end * (PEAK_POINTS - 1)], slope = {0};
        Mask top = absolute(there) >= highest;
        if (!any(top)) continue;
        for (int p = 0; p < PEAK_POINTS; p++) slope += end_slopes[p] * samples[p];
        slope = choose(there < 0, -slope, slope); /* slope of the absolute value */
        inside &= ~top | (end ? slope < 0 : slope > 0);
    }
    return inside;
}
