/* Polynomials of the gain over a group of stretches, as gain_pieces.pieces has it, by hand.

   What depends on the plant alone is worked out first, and once where all lanes share it. Matrices lie
   row by row; what has a column for each command, or force, lies transposed, with a row for each.
   native_designs.py gives the arguments. */

#include "native_matrices.h"

/* The last two: what takes values at nodes to the ends of a stretch, and values with rates at its ends to
   the polynomial through them. */
enum { A, B, E, SHAPE, LAW, COSTS, LENGTH, Q, INVERSE, AT_ENDS, HERMITE, ARGUMENTS };
enum { RATES = 3, POWERS = 2 * RATES };
/* What P does to these is wanted: B and its rate; A B, A B_1 and A A B, with the forces; and the rest of
   the rate of A B, and of that of B_1. */
enum { VALUE, RATE, ONCE, AFTER_RATE, TWICE, TURN, BEND, KINDS, FEW = 3 };

typedef struct {
    int states, inputs, forces, directions, row, far; /* of a kind, and of a force: numbers */
} Sizes;

typedef struct {
    Lanes *push, *seen, *rows, *weighted; /* by rate: W' and V; by kind: the rows, and a few times Q */
} Edge;

typedef struct {
    Lanes *A, *turned, *Q, *B, *E, *inverse; /* of the plant; B and E transposed */
    Lanes *shape, *law, *direct, *share;     /* for short */
    Lanes *cost, *held, *back, *falls, *gains, *edges;
} Room;

static int of_edge(const Sizes *n) { return 2 * RATES * n->far + (KINDS + FEW) * n->row; }

static Edge edge_of(const Room *room, const Sizes *n, int s) {
    Lanes *push = room->edges + s * of_edge(n), *seen = push + RATES * n->far;
    Lanes *rows = seen + RATES * n->far;
    return (Edge){push, seen, rows, rows + KINDS * n->row};
}

/* Values at an edge, and their rates, from those at the nodes of a stretch. */
static void at_edge(Lanes *to, const Array *nodes, const double *weights, int64_t stretch, int size,
                    Span span) {
    memset(to, 0, (size_t)(RATES * size) * sizeof *to);
    for (int p = 0; p < NODES; p++)
        for (int i = 0; i < size; i++) {
            const Lanes value = entry(nodes, (stretch * NODES + p) * size + i, span);
            for (int r = 0; r < RATES; r++) to[r * size + i] += weights[r * NODES + p] * value;
        }
}

/* to += what the plant, constant part and forces, does to some rows: (A x + W V x)'. */
static void add_driven(Lanes *to, const Lanes *rows, int count, const Edge *edge, const Room *room,
                       const Sizes *n) {
    add_dots(to, rows, count, room->A, n->states, n->states);
    dots(room->share, rows, count, edge->seen, n->forces, n->states);
    add_shares(to, room->share, count, edge->push, n->forces, n->states);
}

/* to += rows (A + W V). */
static void add_back(Lanes *to, const Lanes *rows, int count, const Edge *edge, const Room *room,
                     const Sizes *n) {
    add_dots(to, rows, count, room->turned, n->states, n->states);
    dots(room->share, rows, count, edge->push, n->forces, n->states);
    add_shares(to, room->share, count, edge->seen, n->forces, n->states);
}

static void tabulate(const Edge *edge, const Room *room, const Sizes *n) {
    const int states = n->states, inputs = n->inputs, forces = n->forces, row = n->row, far = n->far;
    const int both = states + inputs;
    memset(edge->push, 0, (size_t)(RATES * far) * sizeof(Lanes));
    memset(edge->rows, 0, (size_t)(KINDS * row) * sizeof(Lanes));
    for (int r = 0; r < RATES; r++) {
        const Lanes *shape = room->shape + r * n->directions * forces, *law = room->law + r * forces * both;
        for (int f = 0; f < forces; f++) {
            for (int d = 0; d < n->directions; d++)
                for (int i = 0; i < states; i++)
                    edge->push[r * far + f * states + i] +=
                        shape[d * forces + f] * room->E[d * states + i];
            memcpy(edge->seen + r * far + f * states, law + f * both, (size_t)states * sizeof(Lanes));
            for (int u = 0; u < inputs; u++)
                room->direct[(r * inputs + u) * forces + f] = law[f * both + states + u];
        }
    }
    Lanes *rows = edge->rows, *share = room->share;
    memcpy(rows, room->B, (size_t)row * sizeof(Lanes));
    for (int r = 0; r < RATES; r++) /* the rates of W D */
        for (int k = 0; k <= r; k++) {
            for (int i = 0; i < inputs * forces; i++)
                share[i] = (r == 2 && k == 1 ? 2 : 1) * room->direct[k * inputs * forces + i];
            Lanes *to = rows + (r == 2 ? BEND : r) * row;
            add_shares(to, share, inputs, edge->push + (r - k) * far, forces, states);
        }
    add_driven(rows + ONCE * row, rows, inputs, edge, room, n);
    add_driven(rows + AFTER_RATE * row, rows + RATE * row, 2 * inputs, edge, room, n);
    for (int r = 0; r < 2; r++) {
        dots(share, rows, inputs, edge->seen + r * far, forces, states);
        add_shares(rows + TURN * row, share, inputs, edge->push + (1 - r) * far, forces, states);
    }
    dots(edge->weighted, rows, FEW * inputs, room->Q, states, states);
}

/* The gain at an edge, its rate and the rate of that, by share of a stretch; see gain_pieces._gains. */
static void find_gains(Lanes *gains, const Edge *edge, Lanes length, const Room *room, const Sizes *n) {
    const int states = n->states, inputs = n->inputs, row = n->row, far = n->far;
    Lanes *held = room->held, *falls = room->falls, *back = room->back, *share = room->share;
    Lanes *faster = room->held + RATE * row, *last = room->held + BEND * row;
    const size_t bytes = (size_t)row * sizeof(Lanes);
    memset(gains, 0, RATES * bytes);
    dots(held, edge->rows, KINDS * inputs, room->cost, states, states);
    add_shares(gains, room->inverse, inputs, held, inputs, states);
    memset(back, 0, FEW * bytes);
    add_back(back, held, FEW * inputs, edge, room, n);
    memset(falls, 0, FEW * bytes);
    dots(share, edge->rows, FEW * inputs, held, inputs, states);
    add_shares(falls, share, FEW * inputs, gains, inputs, states);
    for (int i = 0; i < FEW * row; i++)
        falls[i] = length * (falls[i] - held[ONCE * row + i] - back[i] - edge->weighted[i]);
    for (int i = 0; i < row; i++) faster[i] += falls[i]; /* now the rate of P B */
    memset(back, 0, bytes);
    add_back(back, falls, inputs, edge, room, n);
    for (int r = 0; r < 2; r++) {
        dots(share, held, inputs, edge->push + (1 - r) * far, n->forces, states);
        add_shares(back, share, inputs, edge->seen + r * far, n->forces, states);
    }
    Lanes *mixed = falls; /* what fell is known */
    memset(mixed, 0, bytes);
    dots(share, edge->rows, inputs, gains, inputs, states);
    add_shares(mixed, share, inputs, faster, inputs, states);
    dots(share, edge->rows, inputs, faster, inputs, states);
    add_shares(mixed, share, inputs, gains, inputs, states);
    for (int i = 0; i < row; i++)
        last[i] += 2 * falls[row + i] +
                   length * (mixed[i] - falls[2 * row + i] - held[TURN * row + i] - back[i]);
    add_shares(gains + row, room->inverse, inputs, faster, inputs, states);
    add_shares(gains + 2 * row, room->inverse, inputs, last, inputs, states);
}

static void fetch_turned(Lanes *to, const Array *from, int rows, int columns, Span span) {
    for (int i = 0; i < rows; i++)
        for (int j = 0; j < columns; j++) to[j * rows + i] = entry(from, i * columns + j, span);
}

static void prepare(const Array *in, int stretches, const Room *room, const Sizes *n, Span span) {
    const int states = n->states;
    fetch(room->A, in + A, 0, states * states, span);
    fetch_turned(room->turned, in + A, states, states, span);
    fetch(room->Q, in + Q, 0, states * states, span);
    fetch_turned(room->B, in + B, states, n->inputs, span);
    fetch_turned(room->E, in + E, states, n->directions, span);
    for (int s = 0; s <= stretches; s++) {
        const double *weights = in[AT_ENDS].data + (s == stretches) * RATES * NODES;
        const int nodes = s < stretches ? s : s - 1;
        at_edge(room->shape, in + SHAPE, weights, nodes, n->directions * n->forces, span);
        at_edge(room->law, in + LAW, weights, nodes, n->forces * (states + n->inputs), span);
        const Edge edge = edge_of(room, n, s);
        tabulate(&edge, room, n);
    }
}

static void fit(const Array *in, double *out, int stretches, const Room *room, const Sizes *n,
                Span span) {
    const int square = n->states * n->states, row = n->row;
    const Lanes length = entry(in + LENGTH, 0, span);
    fetch(room->inverse, in + INVERSE, 0, n->inputs * n->inputs, span);
    for (int s = 0; s <= stretches; s++) {
        /* Of this edge and the one before it, in turn. */
        Lanes *gains = room->gains + s % 2 * RATES * row;
        const Lanes *ends[] = {room->gains + (s + 1) % 2 * RATES * row, gains};
        fetch(room->cost, in + COSTS, s * square, square, span);
        const Edge edge = edge_of(room, n, s);
        find_gains(gains, &edge, length, room, n);
        for (int i = 0; s > 0 && i < row; i++) {
            Lanes sums[POWERS] = {{0}};
            for (int e = 0; e < 2; e++)
                for (int r = 0; r < RATES; r++) {
                    const Lanes value = ends[e][r * row + i];
                    for (int p = 0; p < POWERS; p++)
                        sums[p] += in[HERMITE].data[(e * RATES + r) * POWERS + p] * value;
                }
            for (int p = 0; p < POWERS; p++) keep(out, ((s - 1) * POWERS + p) * row + i, sums[p], span);
        }
    }
}

static Sizes sizes_of(int states, int inputs, int forces, int directions) {
    return (Sizes){states, inputs, forces, directions, inputs * states, forces * states};
}

static int64_t lay_out(Room *room, const Sizes *n, int stretches, Lanes *memory) {
    const int square = n->states * n->states, wide = n->forces > n->inputs ? n->forces : n->inputs;
    const Room_part parts[] = {{&room->A, square},
                               {&room->turned, square},
                               {&room->Q, square},
                               {&room->cost, square},
                               {&room->B, n->row},
                               {&room->E, n->directions * n->states},
                               {&room->inverse, n->inputs * n->inputs},
                               {&room->shape, RATES * n->directions * n->forces},
                               {&room->law, RATES * n->forces * (n->states + n->inputs)},
                               {&room->direct, RATES * n->inputs * n->forces},
                               {&room->share, FEW * n->inputs * wide},
                               {&room->held, KINDS * n->row},
                               {&room->back, FEW * n->row},
                               {&room->falls, FEW * n->row},
                               {&room->gains, 2 * RATES * n->row},
                               {&room->edges, (stretches + 1) * of_edge(n)}};
    return divide(parts, sizeof parts / sizeof *parts, memory);
}

/* How many numbers of memory a call needs. */
int64_t pieces_room(int states, int inputs, int forces, int directions, int stretches) {
    Room room;
    const Sizes n = sizes_of(states, inputs, forces, directions);
    return lay_out(&room, &n, stretches, NULL);
}

XLA_FFI_Error *pieces(XLA_FFI_CallFrame *frame) {
    if (asked(frame)) return NULL;
    Array in[ARGUMENTS];
    Room room;
    int64_t lanes;
    int shared = 1;
    arrays(in, frame, ARGUMENTS);
    double *out = result(frame, 0, &lanes);
    const int stretches = (int)in[SHAPE].dims[0];
    const Sizes n = sizes_of((int)in[B].dims[0], (int)in[B].dims[1], (int)in[LAW].dims[2],
                             (int)in[E].dims[1]);
    lay_out(&room, &n, stretches, memory(frame, 1));
    for (int i = 0; i <= Q; i++) shared &= i == COSTS || in[i].lanes == 1;
    for (int64_t first = 0; first < lanes; first += WIDE) {
        const Span span = span_of(first, lanes);
        if (!first || !shared) prepare(in, stretches, &room, &n, span);
        fit(in, out, stretches, &room, &n, span);
    }
    return NULL;
}
