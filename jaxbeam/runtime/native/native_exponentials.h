/* Exact propagation over the steps of each panel, exponentials.propagators, and what is watched of it.

   The command line tells TERMS (of the series) and DOUBLINGS. */

#pragma once

#include "native_work.h"

/* Fractions of steps side by side: of which panel, and which they are. */
typedef struct {
    int many, panel[WIDE], fraction[WIDE];
    Lanes span;
} Fractions;

/* The next few; panels without steps are passed over. */
static Fractions next(const Work *w, int *panel, int *fraction) {
    Fractions f = {0};
    while (f.many < WIDE && *panel < w->panels) {
        if (*fraction == FRACTIONS || steps_of(w, *panel) <= 0) {
            ++*panel, *fraction = 0;
            continue;
        }
        const double share = *fraction < NODES ? w->in[GAUSS][*fraction] : 1;
        f.span[f.many] = w->in[LENGTHS][*panel] * share;
        f.panel[f.many] = *panel, f.fraction[f.many++] = (*fraction)++;
    }
    return f;
}

/* to = left right. */
static void multiply(Lanes *to, const Lanes *left, int rows, int terms, const Lanes *right, int columns) {
    memset(to, 0, (size_t)rows * (size_t)columns * sizeof *to);
    add_shares(to, left, rows, right, terms, columns);
}

/* Scale of the states that gives deflections and speeds of modes equal size. */
static void balance(const Work *w, const double *matrix) {
    for (int i = 0; i < w->side; i++) {
        const int place = i % 2 == 0 && i < 2 * w->modes;
        w->balance[i] = place ? sqrt(1 + fabs(matrix[(i + 1) * w->side + i])) : 1;
    }
}

static const double INVERSE_FACTORIAL[] = {1, 1, 1 / 2., 1 / 6., 1 / 24., 1 / 120., 1 / 720.};
_Static_assert(NODES < sizeof INVERSE_FACTORIAL / sizeof(double), "factorials for all nodes");

/* Exponential (side, side) of a block over the fractions, and phi functions of it times the forces
   (side, phi and mode): a series for a part of them, doubled. */
static void exponentials(Work *w, const double *matrix, Lanes span) {
    const int side = w->side, modes = w->modes, width = side + modes, many = NODES * modes;
    for (int i = 0; i < side; i++)
        for (int j = 0; j < side; j++)
            w->matrix[i * side + j] =
                span * (matrix[i * side + j] * w->balance[i] / w->balance[j] / (1 << DOUBLINGS));
    Lanes *sums = w->both, *product = w->product; /* identity and forces, then the sums over them */
    memset(sums, 0, (size_t)(side * width) * sizeof *sums);
    for (int i = 0; i < side; i++) sums[i * width + i] = all(1);
    for (int m = 0; m < modes; m++) sums[(2 * m + 1) * width + side + m] = all(1);
    for (int term = TERMS; term > 0; term--) {
        multiply(product, w->matrix, side, side, sums, width);
        for (int i = 0; i < side; i++)
            for (int j = 0; j < width; j++) {
                const int own = j < side ? i == j : i == 2 * (j - side) + 1;
                sums[i * width + j] = product[i * width + j] / (term + (j < side ? 0 : NODES)) + own;
            }
    }
    for (int i = 0; i < side; i++) {
        memcpy(w->exponential + i * side, sums + i * width, (size_t)side * sizeof *sums);
        for (int m = 0; m < modes; m++)
            w->phi[i * many + (NODES - 1) * modes + m] = sums[i * width + side + m] * INVERSE_FACTORIAL[NODES];
    }
    for (int p = NODES - 1; p > 0; p--) {
        for (int i = 0; i < side; i++)
            for (int m = 0; m < modes; m++) {
                Lanes sum = all(i == 2 * m + 1 ? INVERSE_FACTORIAL[p] : 0);
                for (int k = 0; k < side; k++)
                    sum += w->matrix[i * side + k] * w->phi[k * many + p * modes + m];
                w->phi[i * many + (p - 1) * modes + m] = sum;
            }
    }
    for (int d = 0; d < DOUBLINGS; d++) {
        multiply(w->phi_after, w->exponential, side, side, w->phi, many);
        for (int p = 0; p < NODES; p++)
            for (int i = 0; i < side; i++) {
                Lanes *after = w->phi_after + i * many + p * modes;
                for (int q = 0; q <= p; q++)
                    for (int m = 0; m < modes; m++)
                        after[m] += w->phi[i * many + q * modes + m] * INVERSE_FACTORIAL[p - q];
                for (int m = 0; m < modes; m++) after[m] /= 2 << p;
            }
        multiply(w->doubled, w->exponential, side, side, w->exponential, side);
        Lanes *spare = w->phi;
        w->phi = w->phi_after, w->phi_after = spare;
        spare = w->exponential, w->exponential = w->doubled, w->doubled = spare;
    }
}

/* Propagators of a block from its exponentials; forces are polynomials through their values at the nodes. */
static void keep_propagators(Work *w, int block, const Fractions *f) {
    const int side = w->side, modes = w->modes, many = NODES * modes;
    for (int i = 0; i < side; i++)
        for (int j = 0; j < side; j++) {
            const Lanes drift = w->exponential[i * side + j] * (w->balance[j] / w->balance[i]);
            for (int l = 0; l < f->many; l++) {
                double *end = w->drift + (size_t)f->panel[l] * drift_of(w);
                double *nodes = w->drift_nodes + (size_t)f->panel[l] * drift_nodes_of(w);
                if (f->fraction[l] == NODES) end[(block * side + j) * side + i] = drift[l];
                else nodes[((block * side + i) * side + j) * PADDED + f->fraction[l]] = drift[l];
            }
        }
    for (int i = 0; i < side; i++)
        for (int m = 0; m < modes; m++)
            for (int force = 0; force < NODES; force++) {
                Lanes push = {0};
                for (int p = 0; p < NODES; p++)
                    push += w->weights[force * NODES + p] * w->phi[i * many + p * modes + m];
                push /= w->balance[i];
                const ptrdiff_t at = (ptrdiff_t)((block * side + i) * modes + m) * PADDED + force;
                for (int l = 0; l < f->many; l++) {
                    double *end = w->push + (size_t)f->panel[l] * push_of(w);
                    double *nodes = w->push_nodes + (size_t)f->panel[l] * push_nodes_of(w);
                    if (f->fraction[l] == NODES) end[at] = push[l];
                    else nodes[(size_t)f->fraction[l] * push_of(w) + (size_t)at] = push[l];
                }
            }
}

/* What the powers of the polynomials count, for forces at the nodes: (force, power). */
static void weigh(const Work *w, const Fractions *f) {
    for (int l = 0; l < WIDE; l++) {
        const double share = l < f->many && f->fraction[l] < NODES ? w->in[GAUSS][f->fraction[l]] : 1;
        double power = f->span[l];
        for (int p = 0; p < NODES; p++, power *= share)
            for (int force = 0; force < NODES; force++) {
                const int at = force * NODES + p;
                w->weights[at][l] = w->in[LAGRANGE][at] / INVERSE_FACTORIAL[p] * power;
            }
    }
}

/* What is seen of the propagators at the places that are watched, at the points of a step. */
static void see(const Work *w, int panel) {
    const int side = w->side, modes = w->modes, all_modes = w->all_modes, looked = w->looked;
    const int padded = filled(looked);
    const double *drift = w->drift + (size_t)panel * drift_of(w);
    const double *push = w->push + (size_t)panel * push_of(w);
    const double *drift_nodes = w->drift_nodes + (size_t)panel * drift_nodes_of(w);
    const double *push_nodes = w->push_nodes + (size_t)panel * push_nodes_of(w);
    double *watch = w->watch + (size_t)panel * watch_of(w);
    double *watch_push = w->watch_push + (size_t)panel * watch_push_of(w);
    memset(watch_push, 0, 8 * watch_push_of(w));
    for (int point = 0; point < POINTS; point++)
        for (int place = 0; place < w->places; place++) {
            const int at = point * w->places + place, node = point - 1;
            for (int state = 0; state < w->states; state++) {
                const int b = state / side, j = state % side;
                const double *sights = w->sights + place * all_modes + b * modes;
                double sum = 0;
                for (int m = 0; m < modes; m++) {
                    const int i = 2 * m;
                    if (point == 0) sum += sights[m] * (i == j);
                    else if (node == NODES) sum += sights[m] * drift[(b * side + j) * side + i];
                    else sum += sights[m] * drift_nodes[((b * side + i) * side + j) * PADDED + node];
                }
                watch[state * looked + at] = sum;
            }
            if (point == 0) continue;
            const double *pushes = node == NODES ? push : push_nodes + (size_t)node * push_of(w);
            for (int input = 0; input < all_modes; input++) {
                const int b = input / modes, k = input % modes;
                const double *sights = w->sights + place * all_modes + b * modes;
                for (int force = 0; force < NODES; force++) {
                    double sum = 0;
                    for (int m = 0; m < modes; m++)
                        sum += sights[m] * pushes[((b * side + 2 * m) * modes + k) * PADDED + force];
                    watch_push[(force * all_modes + input) * padded + at] = sum;
                }
            }
        }
}

/* Propagators of all panels that have steps. */
static void propagators(Work *w) {
    memset(w->drift_nodes, 0, 8 * (size_t)w->panels * drift_nodes_of(w));
    memset(w->push_nodes, 0, 8 * (size_t)w->panels * push_nodes_of(w));
    memset(w->push, 0, 8 * (size_t)w->panels * push_of(w));
    int panel = 0, fraction = 0;
    for (Fractions f; (f = next(w, &panel, &fraction)).many;) {
        weigh(w, &f);
        for (int b = 0; b < w->blocks; b++) {
            const double *matrix = w->in[STATE_MATRIX] + (ptrdiff_t)b * w->side * w->side;
            balance(w, matrix);
            exponentials(w, matrix, f.span);
            keep_propagators(w, b, &f);
        }
    }
    for (int p = 0; p < w->panels; p++)
        if (steps_of(w, p) > 0) see(w, p);
}
