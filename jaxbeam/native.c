/* A chunk of steps for all lanes of a task, by hand: what tables.tabulate, advance.advance and
   extremes.fold do for steps without a driver.

   What depends on the path alone is worked out first. Lanes are then taken in groups that fill a
   vector register, and a group goes through all steps of the chunk before the next begins, so that
   its states stay where they are worked on. native.py compiles this file and gives the arguments. */

#include <stdlib.h>

#include "native_lanes.h"
#include "xla/ffi/api/c_api.h"

/* native.py tells on the command line: STEPS (of a chunk), NODES (Gauss nodes a step), POINTS (looked at in
   a step, both ends among them), NEAR (as in extremes.py), ROUNDS and REACH (of Newton's method in
   peaks.vertex). Where nodes or points are the last axis it is padded to a multiple of FILL. */
enum { PADDED = (NODES + FILL - 1) / FILL * FILL };

static inline Lanes value(const Lanes *coefficients, int terms, Lanes place) {
    Lanes sum = coefficients[terms - 1];
    for (int i = terms - 2; i >= 0; i--) sum = coefficients[i] + place * sum;
    return sum;
}

static inline Lanes size_of(Lanes deflection, int both) {
    return both ? absolute(deflection) : deflection;
}

/* Largest size of a value of the curve through samples, as peaks.vertex has it. */
static inline Lanes vertex(const Lanes *samples, const double *curve, const double *points,
                           int both) {
    Lanes highest = size_of(samples[0], both), place = all(-1);
    Lanes powers[POINTS], slope[POINTS - 1], bend[POINTS - 2], reach = all(REACH);
    for (int p = 1; p < POINTS; p++) {
        Lanes size = size_of(samples[p], both);
        Mask higher = size > highest;
        highest = either(higher, size, highest);
        place = either(higher, all(2 * points[p] - 1), place);
    }
    memset(powers, 0, sizeof powers);
    add_product(powers, curve, POINTS, samples, POINTS);
    for (int i = 1; i < POINTS; i++) slope[i - 1] = i * powers[i];
    for (int i = 1; i < POINTS - 1; i++) bend[i - 1] = i * slope[i];
    for (int r = 0; r < ROUNDS; r++) {
        Lanes steep = value(bend, POINTS - 2, place);
        Mask flat = steep == 0;
        Lanes step = value(slope, POINTS - 1, place) / either(flat, all(1), steep);
        step = either(flat, all(0), less(greater(step, -reach), reach));
        place = less(greater(place - step, all(-1)), all(1));
    }
    return greater(size_of(value(powers, POINTS, place), both), highest);
}

/* The arguments: propagators by kind of step, the path, loads, numbers, and what changes. */
enum { DRIFT_NODES, PUSH_NODES, DRIFT, PUSH, WATCH, WATCH_PUSH, KIND, START, SPAN, SLOTS, ACTIVE,
       SHAPE, ROWS, INERTIA, WEIGHT, GAUSS, CURVE, LOOKED,
       STATE, SCORE, SAMPLES, BEST_START, BEST_SPAN, LOWEST, LOST, SOUND, ARGUMENTS };
enum { KEPT = ARGUMENTS - STATE };

typedef struct {
    int rows, states, blocks, side, modes, slots, places, looked; /* modes of a block */
    int64_t lanes;
    const double *in[ARGUMENTS];
    const int64_t *kind, *slot;
    const uint8_t *active, *sound_in;
    double *out[KEPT];
    uint8_t *sound;
} Work;

/* What a step needs of the path. Of no use without a load on the beam, but for drift and watch. */
typedef struct {
    int taken, pressed;
    const double *drift, *watch;
    double *respond, *gains, *push, *seen; /* (state, row), (row, row), (state, row), (row, looked) */
} Step;

static int loaded(const Work *w, int t) {
    int pressed = 0;
    for (int s = 0; s < w->slots; s++) pressed |= w->active[t * w->slots + s];
    return pressed;
}

/* Numbers that the tables of a step take. */
static size_t tables_of(const Work *w) {
    return (size_t)w->rows * (size_t)(2 * w->states + w->rows + w->looked);
}

/* The nodes from a given one on, as many as fill a register, of one load: the state that each feels, the
   rig's answer to its force, and what the forces at all nodes do there. Nodes are the last axis. */
static void tabulate_nodes(const Work *w, const Step *step, ptrdiff_t kind, ptrdiff_t load_of, int p,
                           int first, Lanes *felt) {
    const int side = w->side, modes = w->modes, all_modes = w->blocks * modes;
    const int rows = w->rows, states = w->states, last = NODES - first;
    const int many = last < WIDE ? last : WIDE;
    const double *drift_nodes = w->in[DRIFT_NODES] + kind * states * side * PADDED + first;
    const double *push_nodes = w->in[PUSH_NODES] + kind * NODES * states * modes * PADDED + first;
    const double *push_end = w->in[PUSH] + kind * states * modes * PADDED + first;
    const double *shape = w->in[SHAPE] + load_of * all_modes * PADDED + first;
    const double *feels = w->in[ROWS] + load_of * states * PADDED + first;
    double *respond = step->respond + p * NODES + first, *push = step->push + p * NODES + first;
    for (int i = 0; i < states; i++) {
        const double *rows_of = feels + i / side * side * PADDED;
        const double *drifts = drift_nodes + i / side * side * side * PADDED + i % side * PADDED;
        Lanes responds = {0}, pushes = {0};
        for (int j = 0; j < side; j++)
            responds += whole(rows_of + j * PADDED) * whole(drifts + j * side * PADDED);
        for (int m = 0; m < modes; m++)
            pushes += whole(shape + (i / side * modes + m) * PADDED) *
                      whole(push_end + (i * modes + m) * PADDED);
        store(respond + i * rows, responds, many);
        store(push + i * rows, pushes, many);
    }
    for (int c = 0; c < NODES; c++) {
        const double *there = shape - first + c, *feels_there = feels - first + c;
        Lanes here = {0}; /* the force itself bends the beam under it, at once */
        if (c >= first && c < first + WIDE) here[c - first] = 1;
        for (int m = 0; m < all_modes; m++) {
            const int from = m / modes * side;
            const double *pushes = push_nodes + (c * states * modes + m % modes) * PADDED;
            Lanes sum = here * there[m * PADDED];
            for (int i = from; i < from + side; i++)
                sum += feels_there[i * PADDED] * whole(pushes + i * modes * PADDED);
            felt[m] = sum;
        }
        for (int q = 0; q < w->slots; q++) {
            const double *under = shape + (q - p) * all_modes * PADDED;
            Lanes gains = {0};
            for (int m = 0; m < all_modes; m++) gains += felt[m] * whole(under + m * PADDED);
            store(step->gains + (p * NODES + c) * rows + q * NODES + first, gains, many);
        }
    }
}

static void tabulate(const Work *w, int t, Step *step, Lanes *felt, double *room) {
    const int all_modes = w->blocks * w->modes, rows = w->rows, states = w->states;
    const int looked = w->looked, filled = (looked + FILL - 1) / FILL * FILL;
    const ptrdiff_t kind = (ptrdiff_t)w->kind[t];
    step->taken = w->in[SPAN][t] != 0; /* steps of no length fill up a chunk */
    step->pressed = step->taken && loaded(w, t);
    step->drift = w->in[DRIFT] + kind * states * w->side;
    step->watch = w->in[WATCH] + kind * looked * states;
    step->respond = room;
    step->gains = step->respond + rows * states;
    step->push = step->gains + rows * rows;
    step->seen = step->push + rows * states;
    if (!step->pressed) return;
    const double *sights = w->in[WATCH_PUSH] + kind * NODES * all_modes * filled;
    for (int p = 0; p < w->slots; p++) {
        const ptrdiff_t load_of = (ptrdiff_t)t * w->slots + p;
        const double *shape = w->in[SHAPE] + load_of * all_modes * PADDED;
        for (int first = 0; first < NODES; first += WIDE)
            tabulate_nodes(w, step, kind, load_of, p, first, felt);
        for (int f = 0; f < NODES; f++)
            for (int l = 0; l < looked; l += WIDE) {
                const double *sight = sights + f * all_modes * filled + l;
                Lanes seen = {0};
                for (int m = 0; m < all_modes; m++)
                    seen += shape[m * PADDED + f] * whole(sight + m * filled);
                double *kept = step->seen + (p * NODES + f) * looked + l;
                store(kept, seen, looked - l < WIDE ? looked - l : WIDE);
            }
    }
}

/* The peaks so far, from the samples (step, point, place) of all steps. */
static inline ALWAYS void raise(const Work *w, const Step *steps, const Lanes *seen, ptrdiff_t first,
                                int many, int both) {
    ptrdiff_t plane = (ptrdiff_t)w->places * w->lanes;
    for (int place = 0; place < w->places; place++) {
        ptrdiff_t at = place * w->lanes + first;
        double *start = w->out[BEST_START - STATE] + at, *span = w->out[BEST_SPAN - STATE] + at;
        Lanes score = load(w->out[SCORE - STATE] + at, many), least = score, most[STEPS];
        for (int t = 0; t < STEPS; t++) {
            Lanes highest = {0}, largest = {0};
            for (int p = 0; steps[t].taken && p < POINTS; p++) {
                Lanes sample = seen[(t * POINTS + p) * w->places + place];
                largest = greater(absolute(sample), largest);
                highest = both ? largest : greater(sample, highest);
            }
            least = greater(highest, least);
            most[t] = highest + (NEAR - 1) * largest; /* between samples */
        }
        /* Only steps that may come above the highest of all samples can have the peak. */
        for (int t = 0; t < STEPS; t++) {
            if (!any(most[t] > least)) continue;
            Lanes samples[POINTS];
            for (int p = 0; p < POINTS; p++)
                samples[p] = seen[(t * POINTS + p) * w->places + place];
            Lanes found = vertex(samples, w->in[CURVE], w->in[LOOKED], both);
            Mask better = found > score;
            if (!any(better)) continue;
            score = either(better, found, score);
            for (int p = 0; p < POINTS; p++) {
                double *kept = w->out[SAMPLES - STATE] + p * plane + at;
                store(kept, either(better, samples[p], load(kept, many)), many);
            }
            store(start, either(better, all(w->in[START][t]), load(start, many)), many);
            store(span, either(better, all(w->in[SPAN][t]), load(span, many)), many);
        }
        store(w->out[SCORE - STATE] + at, score, many);
    }
}

/* How little the loads have pressed so far, and when they first would have had to pull. */
static void press(const Work *w, int t, const Lanes *forces, ptrdiff_t first, int many) {
    for (int s = 0; s < w->slots; s++) {
        if (!w->active[t * w->slots + s]) continue;
        ptrdiff_t at = w->slot[t * w->slots + s] * w->lanes + first;
        double *lowest = w->out[LOWEST - STATE] + at, *lost = w->out[LOST - STATE] + at;
        Lanes least = load(lowest, many), when = load(lost, many);
        for (int k = 0; k < NODES; k++) {
            Lanes force = forces[s * NODES + k];
            least = less(-force, least);
            Lanes time = all(w->in[START][t] + w->in[SPAN][t] * w->in[GAUSS][k]);
            when = either(force > 0, less(time, when), when);
        }
        store(lowest, least, many);
        store(lost, when, many);
    }
}

/* The states as they would be without forces; those of a single mode are two. */
static void drift(const Work *w, const double *rows, const Lanes *state, Lanes *after) {
    if (w->side == 2) {
        for (int i = 0; i < w->states; i += 2, rows += 4) {
            after[i] = rows[0] * state[i] + rows[1] * state[i + 1];
            after[i + 1] = rows[2] * state[i] + rows[3] * state[i + 1];
        }
        return;
    }
    memset(after, 0, (size_t)w->states * sizeof *after);
    for (int i = 0; i < w->states; i += w->side, rows += w->side * w->side)
        add_product(after + i, rows, w->side, state + i, w->side);
}

/* All steps of the chunk for one group of lanes. */
static inline ALWAYS void group(const Work *w, const Step *steps, ptrdiff_t first, int many, Lanes *room,
                                int both) {
    Lanes *state = room, *forces = state + w->states, *after = forces + w->rows;
    Lanes *matrix = after + w->states, *samples = matrix + w->rows * w->rows;
    for (int i = 0; i < w->states; i++) state[i] = load(w->in[STATE] + i * w->lanes + first, many);
    for (int t = 0; t < STEPS; t++) {
        const Step *step = steps + t;
        if (!step->taken) continue;
        if (step->pressed) {
            memset(forces, 0, (size_t)w->rows * sizeof *forces);
            product(forces, step->respond, w->rows, 1, w->rows, state, w->states);
            for (int i = 0; i < w->rows; i++) {
                ptrdiff_t slot = t * w->slots + i / NODES, at = w->slot[slot] * w->lanes + first;
                Lanes mass = {0}, weight = {0};
                if (w->active[slot]) {
                    mass = load(w->in[INERTIA] + at, many);
                    weight = load(w->in[WEIGHT] + at, many);
                }
                forces[i] = -(weight + mass * forces[i]);
                for (int j = 0; j < w->rows; j++)
                    matrix[i * w->rows + j] = mass * step->gains[i * w->rows + j];
                matrix[i * w->rows + i] += 1;
            }
            solve(matrix, forces, w->rows);
            press(w, t, forces, first, many);
        }
        Lanes *seen = samples + t * w->looked;
        memset(seen, 0, (size_t)w->looked * sizeof *seen);
        add_product(seen, step->watch, w->looked, state, w->states);
        if (step->pressed)
            product(seen, step->seen, w->looked, 1, w->looked, forces, w->rows);
        drift(w, step->drift, state, after);
        if (step->pressed) add_product(after, step->push, w->states, forces, w->rows);
        memcpy(state, after, (size_t)w->states * sizeof *state);
    }
    raise(w, steps, samples, first, many, both);
    Lanes nothing = {0}; /* unless a state is infinite or not a number, as it then stays */
    for (int i = 0; i < w->states; i++) {
        store(w->out[0] + i * w->lanes + first, state[i], many);
        nothing += 0 * state[i];
    }
    for (int l = 0; l < many; l++)
        w->sound[first + l] = w->sound_in[first + l] && nothing[l] == 0;
}

static XLA_FFI_Error *fault(const XLA_FFI_CallFrame *frame, const char *message) {
    XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, message,
                                      XLA_FFI_Error_Code_INTERNAL};
    return frame->api->XLA_FFI_Error_Create(&args);
}

static inline ALWAYS XLA_FFI_Error *run(XLA_FFI_CallFrame *frame, int both) {
    if (frame->extension_start && frame->extension_start->type == XLA_FFI_Extension_Metadata) {
        /* XLA asks for which version of its interface this was compiled. */
        XLA_FFI_Metadata *about = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
        about->api_version.major_version = XLA_FFI_API_MAJOR;
        about->api_version.minor_version = XLA_FFI_API_MINOR;
        return NULL;
    }
    if (frame->args.size != ARGUMENTS || frame->rets.size != KEPT)
        return fault(frame, "jaxbeam's kernel is of another version than jaxbeam: build it anew");
    Work work, *w = &work;
    const int64_t *dims[ARGUMENTS];
    for (int i = 0; i < ARGUMENTS; i++) {
        XLA_FFI_Buffer *buffer = frame->args.args[i];
        w->in[i] = buffer->data;
        dims[i] = buffer->dims;
    }
    w->kind = (const int64_t *)w->in[KIND];
    w->slot = (const int64_t *)w->in[SLOTS];
    w->active = (const uint8_t *)w->in[ACTIVE];
    w->sound_in = (const uint8_t *)w->in[SOUND];
    w->blocks = (int)dims[DRIFT][1], w->side = (int)dims[DRIFT][2], w->modes = (int)dims[SHAPE][3];
    w->slots = (int)dims[SLOTS][1], w->rows = w->slots * NODES, w->states = w->blocks * w->side;
    w->places = (int)dims[SCORE][0], w->looked = POINTS * w->places, w->lanes = dims[STATE][1];
    for (int i = 0; i < KEPT; i++) {
        XLA_FFI_Buffer *buffer = frame->rets.rets[i];
        w->out[i] = buffer->data;
        size_t bytes = i == SOUND - STATE ? 1 : 8;
        for (int64_t d = 0; d < buffer->rank; d++) bytes *= (size_t)buffer->dims[d];
        /* Peaks so far are updated in place; XLA may give the same memory to argument and result. */
        if (i && w->out[i] != w->in[STATE + i]) memcpy(w->out[i], w->in[STATE + i], bytes);
    }
    w->sound = (uint8_t *)w->out[SOUND - STATE];
    size_t room = (size_t)(2 * w->states + w->rows + w->rows * w->rows + STEPS * w->looked);
    size_t numbers = STEPS * (tables_of(w) + WIDE - 1) / WIDE + STEPS; /* in Lanes */
    Lanes *scratch = aligned_alloc(sizeof(Lanes), (room + numbers) * sizeof(Lanes));
    if (!scratch) return fault(frame, "not enough memory for jaxbeam's kernel");
    Step steps[STEPS];
    for (int t = 0; t < STEPS; t++)
        tabulate(w, t, steps + t, scratch, (double *)(scratch + room) + (size_t)t * tables_of(w));
    for (int64_t first = 0; first < w->lanes; first += WIDE) {
        int64_t left = w->lanes - first;
        group(w, steps, first, left < WIDE ? (int)left : WIDE, scratch, both);
    }
    free(scratch);
    return NULL;
}

/* Deflections to both sides count, or only those upwards. */
XLA_FFI_Error *chunk_of_both_sides(XLA_FFI_CallFrame *frame) { return run(frame, 1); }
XLA_FFI_Error *chunk_of_one_side(XLA_FFI_CallFrame *frame) { return run(frame, 0); }
