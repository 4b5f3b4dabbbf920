/* Flows over stretches of one length, as coupled.coupled_flows has them, by hand.

   Vector registers hold several lanes of a stretch or, where there is but one lane, several stretches.
   Several of these vectors are worked on together, as they share the answers of the constant part, which
   are many. native_designs.py gives the arguments. */

#include "native_matrices.h"

/* Answers of all kinds of stretches, which kind these are, what changes, and what commands cost. */
enum { INNER, END, ANSWER_TOLL, KIND, SHAPE, ROWS, DIRECT, BACK, EFFORT, ARGUMENTS };
enum { DRIFT, PUSH, TOLL, RESULTS };

typedef struct {
    int states, inputs, forces, directions, stretches;
    int values, known, whole, size; /* of commands, with states, with directed forces; of forces */
    int vectors; /* that are worked on together: of stretches, or each of the lanes of one */
    int64_t kind, lanes;
    Array in[ARGUMENTS];
    double *out[RESULTS];
} Work;

/* What is worked on together: so many vectors, of stretches, or each of the lanes of one. */
typedef struct {
    int vectors;
    Span span;
} Part;

typedef struct {
    Lanes *rows, *shape, *seen, *table, *own; /* entries of all vectors side by side */
    Lanes *law, *right;                       /* of each vector, then the next */
    Lanes *ends, *left, *turn, *sums;
} Room;

static int by_stretches(const Work *w) { return w->lanes == 1; }

/* How many stretches a vector holds, if it does not hold lanes. */
static int filled(const Work *w, int vector) {
    const int left = w->stretches - vector * WIDE;
    return left < WIDE ? left : WIDE;
}

/* An entry of what changes, of so many numbers a stretch. */
static Lanes changing(const Work *w, int which, int count, int i, int vector, Span span) {
    const Array *from = w->in + which;
    if (!by_stretches(w)) return entry(from, (int64_t)vector * count + i, span);
    Lanes lanes = {0};
    const double *first = from->data + (ptrdiff_t)vector * WIDE * count + i;
    for (int l = 0, many = filled(w, vector); l < many; l++) lanes[l] = first[(ptrdiff_t)l * count];
    return lanes;
}

static void write(const Work *w, int which, int count, int i, Lanes value, int vector, Span span) {
    double *to = w->out[which];
    if (!by_stretches(w)) {
        keep(to, (int64_t)vector * count + i, value, span);
        return;
    }
    double *first = to + (ptrdiff_t)vector * WIDE * count + i;
    for (int l = 0, many = filled(w, vector); l < many; l++) first[(ptrdiff_t)l * count] = value[l];
}

/* sums (row, column) of answers, from a given entry on, with what lies in `right` by terms and columns. */
static void answered(Lanes *sums, const Work *w, int which, int64_t first, Matrix left, int rows,
                     const Lanes *right, int columns, int terms, Span span) {
    const Matrix by_column = {right, 1, columns};
    for (int i = 0, step; i < rows; i += step) {
        step = taken(rows - i);
        array_rows(sums + i * columns, columns, w->in + which, first + i * left.down, left, step, by_column,
                   columns, terms, span, 0);
    }
}

/* The law of the forces at a node: what they see of what is known, and of themselves. */
static void demand(const Work *w, const Room *room, int node, Part part) {
    const int forces = w->forces, columns = forces * part.vectors, size = w->size, known = w->known;
    const int64_t first = (w->kind * NODES + node) * w->whole * w->states;
    answered(room->seen, w, INNER, first, (Matrix){NULL, w->states, 1}, w->whole,
             room->rows + node * w->states * columns, columns, w->states, part.span);
    for (int v = 0; v < part.vectors; v++)
        for (int r = 0; r < forces; r++) {
            const Lanes *seen = room->seen + r * part.vectors + v;
            const int row = node * forces + r;
            Lanes *right = room->right + (v * size + row) * known;
            Lanes *law = room->law + (v * size + row) * size;
            for (int k = 0; k < known; k++) right[k] = seen[k * columns];
            for (int u = 0; u < w->inputs; u++)
                right[w->states + node * w->inputs + u] +=
                    changing(w, DIRECT, NODES * forces * w->inputs, row * w->inputs + u, v, part.span);
            for (int q = 0; q < NODES; q++)
                for (int t = 0; t < forces; t++) {
                    Lanes sum = {0};
                    if (q == node) {
                        sum = changing(w, BACK, NODES * forces * forces, row * forces + t, v, part.span);
                        if (t == r) sum += 1;
                    }
                    for (int d = 0; d < w->directions; d++) {
                        const int at = q * w->directions + d;
                        const Lanes shape = room->shape[at * columns + t * part.vectors + v];
                        sum -= seen[(known + at) * columns] * shape;
                    }
                    law[q * forces + t] = sum;
                }
        }
}

/* right := law^-1 right, by Gauss and Jordan, without pivots as in small.solve_any. */
static void solve_law(Lanes *law, Lanes *right, int size, int known) {
    for (int k = 0; k < size; k++) {
        const Lanes inverse = 1 / law[k * size + k];
        for (int j = k + 1; j < size; j++) law[k * size + j] *= inverse;
        for (int j = 0; j < known; j++) right[k * known + j] *= inverse;
        for (int i = 0; i < size; i++) {
            if (i == k) continue;
            const Lanes share = law[i * size + k];
            for (int j = k + 1; j < size; j++) law[i * size + j] -= share * law[k * size + j];
            for (int j = 0; j < known; j++) right[i * known + j] -= share * right[k * known + j];
        }
    }
}

/* What the forces do to the end, what they cost with what is known, and by themselves. */
static void tabulate(const Work *w, const Room *room, Part part) {
    const int columns = w->forces * part.vectors, directions = w->directions, above = w->states + w->known;
    for (int q = 0; q < NODES; q++) {
        const int first = w->known + q * directions;
        const Matrix left = {NULL, w->whole, 1};
        const Lanes *shape = room->shape + q * directions * columns;
        Lanes *table = room->table + q * above * columns, *to = table + w->states * columns;
        answered(table, w, END, w->kind * w->states * w->whole + first, left, w->states, shape, columns,
                 directions, part.span);
        answered(to, w, ANSWER_TOLL, w->kind * w->whole * w->whole + first, left, w->known, shape, columns,
                 directions, part.span);
        /* Their cost by themselves is symmetric. */
        answered(room->seen, w, ANSWER_TOLL, (w->kind * w->whole + w->known) * w->whole + first, left,
                 (q + 1) * directions, shape, columns, directions, part.span);
        for (int p = 0; p <= q; p++)
            for (int t = 0; t < w->forces; t++)
                for (int s = 0; s < w->forces; s++)
                    for (int v = 0; v < part.vectors; v++) {
                        Lanes sum = {0};
                        for (int d = 0; d < directions; d++) {
                            const int at = p * directions + d;
                            sum += room->shape[at * columns + t * part.vectors + v] *
                                   room->seen[at * columns + s * part.vectors + v];
                        }
                        Lanes *own = room->own + v * w->size * w->size;
                        own[(p * w->forces + t) * w->size + q * w->forces + s] = sum;
                        own[(q * w->forces + s) * w->size + p * w->forces + t] = sum;
                    }
    }
}

/* The flow of a vector, from the forces that what is known calls forth. */
static void conclude(const Work *w, const Room *room, int v, Part part) {
    const int forces = w->forces, size = w->size, known = w->known, states = w->states;
    const int columns = forces * part.vectors, above = states + known;
    const Lanes *force = room->right + v * size * known, *own = room->own + v * size * size;
    Lanes *left = room->left, *turn = room->turn, *sums = room->sums; /* (known, both), (known, both) */
    const Array *ends = w->in + END, *toll = w->in + ANSWER_TOLL;
    for (int i = 0; i < states; i++)
        for (int q = 0; q < NODES; q++)
            for (int t = 0; t < forces; t++)
                room->ends[i * size + q * forces + t] =
                    room->table[(q * above + i) * columns + t * part.vectors + v];
    for (int i = 0; i < states; i++)
        fetch(sums + i * known, ends, (w->kind * states + i) * w->whole, known, part.span);
    add_shares(sums, room->ends, states, force, size, known);
    for (int i = 0; i < states; i++) {
        for (int j = 0; j < states; j++)
            write(w, DRIFT, states * states, i * states + j, sums[i * known + j], v, part.span);
        for (int j = 0; j < w->values; j++)
            write(w, PUSH, states * w->values, i * w->values + j, sums[i * known + states + j], v,
                  part.span);
    }
    /* force' mixed' + mixed force + force' own force: one sum of products of twice as many terms. */
    for (int k = 0; k < size; k++)
        for (int i = 0; i < known; i++) left[i * 2 * size + k] = force[k * known + i];
    for (int i = 0; i < known; i++)
        for (int q = 0; q < NODES; q++)
            for (int t = 0; t < forces; t++)
                left[i * 2 * size + size + q * forces + t] =
                    room->table[(q * above + states + i) * columns + t * part.vectors + v];
    for (int i = 0; i < known * size; i++) sums[i] = (Lanes){0};
    add_products(sums, size, (Matrix){left, 2 * size, 1}, known, (Matrix){own, size, 1}, size, size);
    for (int i = 0; i < known; i++)
        for (int k = 0; k < size; k++) {
            Lanes *mixed = left + i * 2 * size + size + k;
            *mixed += sums[i * size + k] / 2;
            turn[i * 2 * size + k] = *mixed;
            turn[i * 2 * size + size + k] = left[i * 2 * size + k];
        }
    for (int i = 0, step; i < known; i += step) {
        step = taken(known - i);
        for (int k = i; k < i + step; k++) {
            fetch(sums + k * known, toll, (w->kind * w->whole + k) * w->whole, i + step, part.span);
            for (int j = states; k >= states && j < i + step; j++)
                sums[k * known + j] +=
                    entry(w->in + EFFORT, (k - states) * w->values + j - states, part.span);
        }
        few_rows(sums + i * known, known, (Matrix){left + i * 2 * size, 2 * size, 1}, step,
                 (Matrix){turn, 2 * size, 1}, i + step, 2 * size);
    }
    for (int i = 0; i < known; i++)
        for (int j = 0; j <= i; j++) {
            write(w, TOLL, known * known, i * known + j, sums[i * known + j], v, part.span);
            if (j < i) write(w, TOLL, known * known, j * known + i, sums[i * known + j], v, part.span);
        }
}

static void flow(const Work *w, const Room *room, Part part) {
    const int forces = w->forces, columns = forces * part.vectors;
    for (int v = 0; v < part.vectors; v++)
        for (int p = 0; p < NODES; p++) {
            for (int r = 0; r < forces; r++)
                for (int i = 0; i < w->states; i++)
                    room->rows[(p * w->states + i) * columns + r * part.vectors + v] = changing(
                        w, ROWS, NODES * forces * w->states, (p * forces + r) * w->states + i, v, part.span);
            for (int i = 0; i < w->directions * forces; i++)
                room->shape[(p * w->directions * forces + i) * part.vectors + v] =
                    changing(w, SHAPE, NODES * w->directions * forces, p * w->directions * forces + i, v,
                             part.span);
        }
    for (int p = 0; p < NODES; p++) demand(w, room, p, part);
    for (int v = 0; v < part.vectors; v++)
        solve_law(room->law + v * w->size * w->size, room->right + v * w->size * w->known, w->size, w->known);
    tabulate(w, room, part);
    for (int v = 0; v < part.vectors; v++) conclude(w, room, v, part);
}

static void measure(Work *w, int states, int inputs, int directions, int forces, int stretches,
                    int64_t lanes) {
    w->states = states, w->inputs = inputs, w->directions = directions, w->forces = forces;
    w->stretches = stretches, w->lanes = lanes;
    w->values = NODES * inputs, w->known = states + w->values, w->size = NODES * forces;
    w->whole = w->known + NODES * directions;
    w->vectors = lanes == 1 ? (stretches + WIDE - 1) / WIDE : stretches;
}

static int64_t lay_out(Room *room, const Work *w, Lanes *memory) {
    const int columns = w->vectors * w->forces, size = w->size, known = w->known;
    const Room_part parts[] = {{&room->rows, NODES * w->states * columns},
                               {&room->shape, NODES * w->directions * columns},
                               {&room->seen, w->whole * columns},
                               {&room->table, NODES * (w->states + known) * columns},
                               {&room->own, w->vectors * size * size},
                               {&room->law, w->vectors * size * size},
                               {&room->right, w->vectors * size * known},
                               {&room->ends, w->states * size},
                               {&room->left, known * 2 * size},
                               {&room->turn, known * 2 * size},
                               {&room->sums, known * (2 * size > known ? 2 * size : known)}};
    return divide(parts, sizeof parts / sizeof *parts, memory);
}

/* How many numbers of memory a call needs. */
int64_t coupled_room(int states, int inputs, int directions, int forces, int stretches, int lanes) {
    Work work;
    Room room;
    measure(&work, states, inputs, directions, forces, stretches, lanes);
    return lay_out(&room, &work, NULL);
}

XLA_FFI_Error *coupled(XLA_FFI_CallFrame *frame) {
    if (asked(frame)) return NULL;
    Work work, *w = &work;
    Room room;
    int64_t lanes;
    arrays(w->in, frame, ARGUMENTS);
    for (int i = 0; i < RESULTS; i++) w->out[i] = result(frame, i, &lanes);
    const int64_t *shape = w->in[SHAPE].dims;
    measure(w, (int)w->in[END].dims[1], (int)w->in[DIRECT].dims[3], (int)shape[2], (int)shape[3],
            (int)shape[0], lanes);
    w->kind = *(const int64_t *)w->in[KIND].data;
    lay_out(&room, w, memory(frame, RESULTS));
    for (int64_t first = 0; first < lanes; first += WIDE)
        flow(w, &room, (Part){w->vectors, span_of(first, lanes)});
    return NULL;
}
