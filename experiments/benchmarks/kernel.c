/* The method of jaxbeam's integrator by hand, for one pinned span and LANES masses at one speed.

   Exact propagation of the modes, contact forces collocated at Gauss nodes, peaks between samples
   from the polynomial through the points looked at in a step. Propagators come from outside (kernel.py);
   all that depends on the path is worked out here, once for all lanes. */

#include <math.h>

#define LANES 64
#define NODES 6
#define POINTS (NODES + 2)
#define SENSORS 3
#define LOOKED (POINTS * SENSORS)
#define CHUNK 8
#define NEAR 1.1
#define FINE 64
#define STATES (2 * MODES) /* MODES is given on the command line */

typedef double Lanes[LANES];

/* Answers of the free modes over a step of one length; a state is a mode's place and rate. */
typedef struct {
    double drift_nodes[NODES][MODES][2][2], push_nodes[NODES][NODES][MODES][2];
    double drift_end[MODES][2][2], push_end[NODES][MODES][2];
    double watch[LOOKED][MODES][2], watch_push[LOOKED][NODES][MODES];
} Answers;

typedef struct {
    double length, gravity, amplitude[MODES], gauss[NODES];
    double places[POINTS], to_powers[POINTS][POINTS], reach;
    double rates[MODES][2], stiffness[MODES], flexibility[SENSORS];
} Beam;

/* What a step needs of the path. */
typedef struct {
    double respond[NODES][STATES], gains[NODES][NODES], push[STATES][NODES];
    double watch[LOOKED][STATES], seen[LOOKED][NODES];
} Path;

typedef struct {
    Lanes score[SENSORS], samples[SENSORS][POINTS], lowest;
} Best;

static void tabulate(const Beam *beam, const Answers *answers, double speed, double start,
                     double span, Path *path) {
    double shape[NODES][MODES], rows[NODES][MODES][2];
    for (int k = 0; k < NODES; k++) {
        double angle = M_PI * speed * (start + span * beam->gauss[k]) / beam->length;
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
                path->respond[k][2 * m + j] = rows[k][m][0] * answers->drift_nodes[k][m][0][j] +
                                              rows[k][m][1] * answers->drift_nodes[k][m][1][j];
        for (int f = 0; f < NODES; f++) {
            double sum = 0;
            for (int m = 0; m < MODES; m++)
                sum += shape[f][m] * (rows[k][m][0] * answers->push_nodes[k][f][m][0] +
                                      rows[k][m][1] * answers->push_nodes[k][f][m][1] +
                                      (k == f ? shape[k][m] : 0.0));
            path->gains[k][f] = sum;
        }
        for (int m = 0; m < MODES; m++)
            for (int i = 0; i < 2; i++)
                path->push[2 * m + i][k] = answers->push_end[k][m][i] * shape[k][m];
    }
    for (int p = 0; p < LOOKED; p++)
        for (int f = 0; f < NODES; f++) {
            double sum = 0;
            for (int m = 0; m < MODES; m++) sum += answers->watch_push[p][f][m] * shape[f][m];
            path->seen[p][f] = sum;
        }
}

/* Forces of the step: (1 + mass G) r = -(weight + mass felt), eliminated for a few lanes at once. */
#define TOGETHER 8
static void contact(const Path *path, const double *mass, double gravity, Lanes *state,
                    Lanes *force) {
    for (int first = 0; first < LANES; first += TOGETHER) {
        double a[NODES][NODES][TOGETHER], b[NODES][TOGETHER];
        const double *m = mass + first;
        for (int i = 0; i < NODES; i++) {
            double felt[TOGETHER] = {0};
            for (int s = 0; s < STATES; s++)
                for (int l = 0; l < TOGETHER; l++)
                    felt[l] += path->respond[i][s] * state[s][first + l];
            for (int l = 0; l < TOGETHER; l++) b[i][l] = -m[l] * (gravity + felt[l]);
            for (int j = 0; j < NODES; j++)
                for (int l = 0; l < TOGETHER; l++)
                    a[i][j][l] = m[l] * path->gains[i][j] + (i == j ? 1.0 : 0.0);
        }
        for (int i = 0; i < NODES; i++) {
            double inverse[TOGETHER];
            for (int l = 0; l < TOGETHER; l++) inverse[l] = 1 / a[i][i][l];
            for (int k = i + 1; k < NODES; k++) {
                double factor[TOGETHER];
                for (int l = 0; l < TOGETHER; l++) factor[l] = a[k][i][l] * inverse[l];
                for (int j = i + 1; j < NODES; j++)
                    for (int l = 0; l < TOGETHER; l++) a[k][j][l] -= factor[l] * a[i][j][l];
                for (int l = 0; l < TOGETHER; l++) b[k][l] -= factor[l] * b[i][l];
            }
            for (int l = 0; l < TOGETHER; l++) a[i][i][l] = inverse[l];
        }
        for (int i = NODES - 1; i >= 0; i--) {
            for (int j = i + 1; j < NODES; j++)
                for (int l = 0; l < TOGETHER; l++) b[i][l] -= a[i][j][l] * force[j][first + l];
            for (int l = 0; l < TOGETHER; l++) force[i][first + l] = b[i][l] * a[i][i][l];
        }
    }
}

static double value(const double *c, int terms, double x) {
    double sum = c[terms - 1];
    for (int i = terms - 2; i >= 0; i--) sum = c[i] + x * sum;
    return sum;
}

/* Largest absolute value of the polynomial c near x, by rounds of Newton's method. */
static double climb(const double *c, double x, double reach, int rounds) {
    double slope[POINTS - 1], bend[POINTS - 2];
    for (int i = 1; i < POINTS; i++) slope[i - 1] = i * c[i];
    for (int i = 1; i < POINTS - 1; i++) bend[i - 1] = i * slope[i];
    for (int r = 0; r < rounds; r++) {
        double steep = value(bend, POINTS - 2, x);
        double step = steep == 0 ? 0 : value(slope, POINTS - 1, x) / steep;
        x = fmax(-1, fmin(1, x - fmax(-reach, fmin(reach, step))));
    }
    return fabs(value(c, POINTS, x));
}

static void powers(const Beam *beam, const double *samples, double *c) {
    for (int i = 0; i < POINTS; i++) {
        c[i] = 0;
        for (int j = 0; j < POINTS; j++) c[i] += beam->to_powers[i][j] * samples[j];
    }
}

static void fold(const Beam *beam, const Path *path, int pressed, Lanes *state, Lanes *force,
                 Best *best) {
    for (int w = 0; w < SENSORS; w++) {
        double samples[POINTS][LANES], high[LANES] = {0};
        for (int p = 0; p < POINTS; p++) {
            int row = p * SENSORS + w;
            double sum[LANES] = {0};
            for (int s = 0; s < STATES; s++)
                for (int l = 0; l < LANES; l++) sum[l] += path->watch[row][s] * state[s][l];
            if (pressed)
                for (int k = 0; k < NODES; k++)
                    for (int l = 0; l < LANES; l++) sum[l] += path->seen[row][k] * force[k][l];
            for (int l = 0; l < LANES; l++) {
                samples[p][l] = sum[l];
                high[l] = fmax(high[l], fabs(sum[l]));
            }
        }
        for (int l = 0; l < LANES; l++) {
            if (high[l] * NEAR <= best->score[w][l]) continue;
            double mine[POINTS], c[POINTS], top = -1, at = 0;
            for (int p = 0; p < POINTS; p++) {
                mine[p] = samples[p][l];
                if (fabs(mine[p]) > top) top = fabs(mine[p]), at = 2 * beam->places[p] - 1;
            }
            powers(beam, mine, c);
            double score = fmax(top, climb(c, at, beam->reach, 2));
            if (score <= best->score[w][l]) continue;
            best->score[w][l] = score;
            for (int p = 0; p < POINTS; p++) best->samples[w][p][l] = mine[p];
        }
    }
    for (int k = 0; k < (pressed ? NODES : 0); k++)
        for (int l = 0; l < LANES; l++) best->lowest[l] = fmin(best->lowest[l], -force[k][l]);
}

static void advance(const Answers *answers, const Path *path, int pressed, Lanes *state,
                    Lanes *force) {
    for (int m = 0; m < MODES; m++)
        for (int l = 0; l < LANES; l++) {
            double place = state[2 * m][l], rate = state[2 * m + 1][l];
            for (int i = 0; i < 2; i++) {
                double sum = answers->drift_end[m][i][0] * place + answers->drift_end[m][i][1] * rate;
                for (int k = 0; k < (pressed ? NODES : 0); k++)
                    sum += path->push[2 * m + i][k] * force[k][l];
                state[2 * m + i][l] = sum;
            }
        }
}

/* Whether no lane has energy left that could raise any peak. */
static int still(const Beam *beam, Lanes *state, const Best *best) {
    for (int l = 0; l < LANES; l++) {
        double energy = 0;
        for (int m = 0; m < MODES; m++)
            energy += state[2 * m + 1][l] * state[2 * m + 1][l] +
                      beam->stiffness[m] * state[2 * m][l] * state[2 * m][l];
        for (int w = 0; w < SENSORS; w++)
            if (sqrt(beam->flexibility[w] * energy) >= best->score[w][l]) return 0;
    }
    return 1;
}

/* Peaks (lane, sensor) of crossings: `on` steps on the beam, at most `off` steps after it. */
void crossing(const Beam *beam, const Answers *during, const Answers *after, double speed,
              double span, int on, int off, const double *mass, double *peaks) {
    Lanes state[STATES] = {{0}}, force[NODES];
    Best best = {0};
    Path path;
    for (int l = 0; l < LANES; l++) best.lowest[l] = INFINITY;
    for (int p = 0; p < LOOKED; p++)
        for (int s = 0; s < STATES; s++) path.watch[p][s] = during->watch[p][s / 2][s % 2];
    for (int step = 0; step < on; step++) {
        tabulate(beam, during, speed, step * span, span, &path);
        contact(&path, mass, beam->gravity, state, force);
        fold(beam, &path, 1, state, force, &best);
        advance(during, &path, 1, state, force);
    }
    for (int p = 0; p < LOOKED; p++)
        for (int s = 0; s < STATES; s++) path.watch[p][s] = after->watch[p][s / 2][s % 2];
    for (int step = 0; step < off; step++) {
        if (step % CHUNK == 0 && still(beam, state, &best)) break;
        fold(beam, &path, 0, state, force, &best);
        advance(after, &path, 0, state, force);
    }
    for (int w = 0; w < SENSORS; w++)
        for (int l = 0; l < LANES; l++) {
            double mine[POINTS], c[POINTS], top = -1, at = 0;
            for (int p = 0; p < POINTS; p++) mine[p] = best.samples[w][p][l];
            powers(beam, mine, c);
            for (int i = 0; i <= FINE; i++) {
                double x = 2.0 * i / FINE - 1, size = fabs(value(c, POINTS, x));
                if (size > top) top = size, at = x;
            }
            peaks[l * SENSORS + w] = fmax(top, climb(c, at, 2.0 / FINE, 4));
        }
}
