/* The method of jaxbeam's integrator by hand: one pinned span, BATCH masses at one speed.

   Exact propagation of the modes, contact forces collocated at Gauss nodes, peaks between samples
   from the polynomial through PEAK_NODES samples of a step. Propagators come from kernel.py; what
   depends on the load path is computed here, once for the whole batch. */

#include <math.h>

#define BATCH 64
#define NODES 6                    /* Gauss nodes of a step */
#define PEAK_NODES (NODES + 2)     /* and its two ends, at which deflections are sampled */
#define SENSORS 3
#define ROWS (PEAK_NODES * SENSORS)
#define CHECK_INTERVAL 8           /* steps between two checks of the energy */
#define SEARCH_FACTOR 1.1          /* samples that times this are below the peak are not refined */
#define FINE_POINTS 64
#define STATES (2 * MODES)         /* MODES is given on the command line */

typedef double Batch[BATCH];

/* Response of the modes over a step of one length; a mode's state is its coordinate and rate. */
typedef struct {
    double transition_nodes[NODES][MODES][2][2], input_nodes[NODES][NODES][MODES][2];
    double transition_end[MODES][2][2], input_end[NODES][MODES][2];
    double monitored[ROWS][MODES][2], monitored_input[ROWS][NODES][MODES];
} StepMatrices;

typedef struct {
    double length, gravity, amplitude[MODES], gauss_nodes[NODES];
    double peak_nodes[PEAK_NODES], to_coefficients[PEAK_NODES][PEAK_NODES], newton_limit;
    double rates[MODES][2], stiffness[MODES], flexibility[SENSORS];
} Beam;

/* Step matrices along the load path: contact_response and contact_gain take states and contact
   forces to accelerations under the load; force_response takes forces to the state at the end. */
typedef struct {
    double contact_response[NODES][STATES], contact_gain[NODES][NODES];
    double force_response[STATES][NODES];
    double monitored[ROWS][STATES], monitored_force[ROWS][NODES];
} LoadPath;

typedef struct {
    Batch peak[SENSORS], samples[SENSORS][PEAK_NODES], lowest_force;
} RunningPeaks;

static void assemble_load_path(const Beam *beam, const StepMatrices *matrices, double speed,
                               double start, double step_length, LoadPath *path) {
    double shape[NODES][MODES], rows[NODES][MODES][2];
    for (int k = 0; k < NODES; k++) {
        double time = start + step_length * beam->gauss_nodes[k];
        double angle = M_PI * speed * time / beam->length;
        double one = sin(angle), twice = 2 * cos(angle), before = 0.0, now = one;
        double before_slope = 1.0, now_slope = cos(angle);
        for (int m = 0; m < MODES; m++) {
            double number = (m + 1) * M_PI / beam->length, phi = beam->amplitude[m] * now;
            shape[k][m] = phi;
            rows[k][m][0] = beam->rates[m][0] * phi - speed * speed * number * number * phi;
            rows[k][m][1] = beam->rates[m][1] * phi +
                            2 * speed * number * beam->amplitude[m] * now_slope;
            double next = twice * now - before, next_slope = twice * now_slope - before_slope;
            before = now, now = next, before_slope = now_slope, now_slope = next_slope;
        }
    }
    for (int k = 0; k < NODES; k++) {
        for (int m = 0; m < MODES; m++)
            for (int j = 0; j < 2; j++)
                path->contact_response[k][2 * m + j] =
                    rows[k][m][0] * matrices->transition_nodes[k][m][0][j] +
                    rows[k][m][1] * matrices->transition_nodes[k][m][1][j];
        for (int f = 0; f < NODES; f++) {
            double sum = 0;
            for (int m = 0; m < MODES; m++)
                sum += shape[f][m] * (rows[k][m][0] * matrices->input_nodes[k][f][m][0] +
                                      rows[k][m][1] * matrices->input_nodes[k][f][m][1] +
                                      (k == f ? shape[k][m] : 0.0));
            path->contact_gain[k][f] = sum;
        }
        for (int m = 0; m < MODES; m++)
            for (int i = 0; i < 2; i++)
                path->force_response[2 * m + i][k] = matrices->input_end[k][m][i] * shape[k][m];
    }
    for (int p = 0; p < ROWS; p++)
        for (int f = 0; f < NODES; f++) {
            double sum = 0;
            for (int m = 0; m < MODES; m++) sum += matrices->monitored_input[p][f][m] * shape[f][m];
            path->monitored_force[p][f] = sum;
        }
}

/* Contact forces r of a step: (1 + mass gain) r = -(weight + mass acceleration), where acceleration
   is that under the load by the state alone. Eliminated for a few runs at once. */
#define ELIMINATED 8
static void solve_contact(const LoadPath *path, const double *mass, double gravity, Batch *state,
                          Batch *force) {
    for (int first = 0; first < BATCH; first += ELIMINATED) {
        double a[NODES][NODES][ELIMINATED], b[NODES][ELIMINATED];
        const double *m = mass + first;
        for (int i = 0; i < NODES; i++) {
            double acceleration[ELIMINATED] = {0};
            for (int s = 0; s < STATES; s++)
                for (int l = 0; l < ELIMINATED; l++)
                    acceleration[l] += path->contact_response[i][s] * state[s][first + l];
            for (int l = 0; l < ELIMINATED; l++) b[i][l] = -m[l] * (gravity + acceleration[l]);
            for (int j = 0; j < NODES; j++)
                for (int l = 0; l < ELIMINATED; l++)
                    a[i][j][l] = m[l] * path->contact_gain[i][j] + (i == j ? 1.0 : 0.0);
        }
        for (int i = 0; i < NODES; i++) {
            double inverse[ELIMINATED];
            for (int l = 0; l < ELIMINATED; l++) inverse[l] = 1 / a[i][i][l];
            for (int k = i + 1; k < NODES; k++) {
                double factor[ELIMINATED];
                for (int l = 0; l < ELIMINATED; l++) factor[l] = a[k][i][l] * inverse[l];
                for (int j = i + 1; j < NODES; j++)
                    for (int l = 0; l < ELIMINATED; l++) a[k][j][l] -= factor[l] * a[i][j][l];
                for (int l = 0; l < ELIMINATED; l++) b[k][l] -= factor[l] * b[i][l];
            }
            for (int l = 0; l < ELIMINATED; l++) a[i][i][l] = inverse[l];
        }
        for (int i = NODES - 1; i >= 0; i--) {
            for (int j = i + 1; j < NODES; j++)
                for (int l = 0; l < ELIMINATED; l++) b[i][l] -= a[i][j][l] * force[j][first + l];
            for (int l = 0; l < ELIMINATED; l++) force[i][first + l] = b[i][l] * a[i][i][l];
        }
    }
}

static double polynomial(const double *c, int terms, double x) {
    double sum = c[terms - 1];
    for (int i = terms - 2; i >= 0; i--) sum = c[i] + x * sum;
    return sum;
}

/* Largest absolute value of the polynomial c near x, by iterations of Newton's method. */
static double refine_peak(const double *c, double x, double newton_limit, int iterations) {
    double slope[PEAK_NODES - 1], curvature[PEAK_NODES - 2];
    for (int i = 1; i < PEAK_NODES; i++) slope[i - 1] = i * c[i];
    for (int i = 1; i < PEAK_NODES - 1; i++) curvature[i - 1] = i * slope[i];
    for (int r = 0; r < iterations; r++) {
        double bend = polynomial(curvature, PEAK_NODES - 2, x);
        double step = bend == 0 ? 0 : polynomial(slope, PEAK_NODES - 1, x) / bend;
        x = fmax(-1, fmin(1, x - fmax(-newton_limit, fmin(newton_limit, step))));
    }
    return fabs(polynomial(c, PEAK_NODES, x));
}

/* Coefficients c of the polynomial through the samples of a step, on -1 to 1. */
static void interpolate(const Beam *beam, const double *samples, double *c) {
    for (int i = 0; i < PEAK_NODES; i++) {
        c[i] = 0;
        for (int j = 0; j < PEAK_NODES; j++) c[i] += beam->to_coefficients[i][j] * samples[j];
    }
}

static void update_peaks(const Beam *beam, const LoadPath *path, int loaded, Batch *state,
                         Batch *force, RunningPeaks *running) {
    for (int w = 0; w < SENSORS; w++) {
        double samples[PEAK_NODES][BATCH], high[BATCH] = {0};
        for (int p = 0; p < PEAK_NODES; p++) {
            int row = p * SENSORS + w;
            double sum[BATCH] = {0};
            for (int s = 0; s < STATES; s++)
                for (int l = 0; l < BATCH; l++) sum[l] += path->monitored[row][s] * state[s][l];
            if (loaded)
                for (int k = 0; k < NODES; k++)
                    for (int l = 0; l < BATCH; l++)
                        sum[l] += path->monitored_force[row][k] * force[k][l];
            for (int l = 0; l < BATCH; l++) {
                samples[p][l] = sum[l];
                high[l] = fmax(high[l], fabs(sum[l]));
            }
        }
        for (int l = 0; l < BATCH; l++) {
            if (high[l] * SEARCH_FACTOR <= running->peak[w][l]) continue;
            double own[PEAK_NODES], c[PEAK_NODES], top = -1, at = 0;
            for (int p = 0; p < PEAK_NODES; p++) {
                own[p] = samples[p][l];
                if (fabs(own[p]) > top) top = fabs(own[p]), at = 2 * beam->peak_nodes[p] - 1;
            }
            interpolate(beam, own, c);
            double peak = fmax(top, refine_peak(c, at, beam->newton_limit, 2));
            if (peak <= running->peak[w][l]) continue;
            running->peak[w][l] = peak;
            for (int p = 0; p < PEAK_NODES; p++) running->samples[w][p][l] = own[p];
        }
    }
    for (int k = 0; k < (loaded ? NODES : 0); k++)
        for (int l = 0; l < BATCH; l++)
            running->lowest_force[l] = fmin(running->lowest_force[l], -force[k][l]);
}

static void propagate(const StepMatrices *matrices, const LoadPath *path, int loaded, Batch *state,
                      Batch *force) {
    for (int m = 0; m < MODES; m++)
        for (int l = 0; l < BATCH; l++) {
            double coordinate = state[2 * m][l], rate = state[2 * m + 1][l];
            for (int i = 0; i < 2; i++) {
                const double *row = matrices->transition_end[m][i];
                double sum = row[0] * coordinate + row[1] * rate;
                for (int k = 0; k < (loaded ? NODES : 0); k++)
                    sum += path->force_response[2 * m + i][k] * force[k][l];
                state[2 * m + i][l] = sum;
            }
        }
}

/* Whether no run has energy left that could raise any of its peaks. */
static int peaks_are_final(const Beam *beam, Batch *state, const RunningPeaks *running) {
    for (int l = 0; l < BATCH; l++) {
        double energy = 0;
        for (int m = 0; m < MODES; m++)
            energy += state[2 * m + 1][l] * state[2 * m + 1][l] +
                      beam->stiffness[m] * state[2 * m][l] * state[2 * m][l];
        for (int w = 0; w < SENSORS; w++)
            if (sqrt(beam->flexibility[w] * energy) >= running->peak[w][l]) return 0;
    }
    return 1;
}

/* Peaks (run, sensor) of crossings: `on` steps on the beam, at most `off` steps after the exit. */
void crossing(const Beam *beam, const StepMatrices *during, const StepMatrices *after, double speed,
              double step_length, int on, int off, const double *mass, double *peaks) {
    Batch state[STATES] = {{0}}, force[NODES];
    RunningPeaks running = {0};
    LoadPath path;
    for (int l = 0; l < BATCH; l++) running.lowest_force[l] = INFINITY;
    for (int p = 0; p < ROWS; p++)
        for (int s = 0; s < STATES; s++) path.monitored[p][s] = during->monitored[p][s / 2][s % 2];
    for (int step = 0; step < on; step++) {
        assemble_load_path(beam, during, speed, step * step_length, step_length, &path);
        solve_contact(&path, mass, beam->gravity, state, force);
        update_peaks(beam, &path, 1, state, force, &running);
        propagate(during, &path, 1, state, force);
    }
    for (int p = 0; p < ROWS; p++)
        for (int s = 0; s < STATES; s++) path.monitored[p][s] = after->monitored[p][s / 2][s % 2];
    for (int step = 0; step < off; step++) {
        if (step % CHECK_INTERVAL == 0 && peaks_are_final(beam, state, &running)) break;
        update_peaks(beam, &path, 0, state, force, &running);
        propagate(after, &path, 0, state, force);
    }
    for (int w = 0; w < SENSORS; w++)
        for (int l = 0; l < BATCH; l++) {
            double own[PEAK_NODES], c[PEAK_NODES], top = -1, at = 0;
            for (int p = 0; p < PEAK_NODES; p++) own[p] = running.samples[w][p][l];
            interpolate(beam, own, c);
            for (int i = 0; i <= FINE_POINTS; i++) {
                double x = 2.0 * i / FINE_POINTS - 1, size = fabs(polynomial(c, PEAK_NODES, x));
                if (size > top) top = size, at = x;
            }
            peaks[l * SENSORS + w] = fmax(top, refine_peak(c, at, 2.0 / FINE_POINTS, 4));
        }
}
