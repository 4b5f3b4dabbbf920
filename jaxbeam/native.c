/* A chunk of steps for all lanes of a task, by hand: what tables.tabulate, advance.advance and
   extremes.fold do for steps without a driver.

   What depends on the path alone is worked out first. Lanes are then taken in groups that fill a
   vector register; two groups go through all steps of the chunk before the next begin, so that
   their states stay where they are worked on. native.py compiles this file and gives the arguments. */

#include "native_peaks.h"
#include "native_tables.h"
#include "xla/ffi/api/c_api.h"

enum { TURNS = 2 }; /* groups at once */

/* What the lanes of a group go through. The contact forces of a step follow its state in memory. */
typedef struct {
    ptrdiff_t first;
    int many;
    Lanes *state, *after, *matrix;
    Lanes *samples;     /* (step, point, place) */
    Lanes *high, *most; /* (step, place): the largest of these, and what may be between them */
} Group;

/* In Lanes. */
static size_t room_of(const Work *w) {
    int rows = w->rows, sights = w->looked + 2 * w->places;
    return (size_t)(2 * (w->states + rows) + rows * rows + STEPS * sights);
}

/* How many numbers a call works on beside its arguments: their memory is XLA's, a result that nobody
   reads. To allocate it in every call would take as long as all the rest. */
int64_t chunk_room(int states, int slots, int places) {
    Work w = {.rows = slots * NODES, .states = states, .places = places, .looked = POINTS * places};
    return (int64_t)((TURNS * room_of(&w) + 1) * WIDE + STEPS * tables_of(&w));
}

/* How little the loads have pressed so far, and when they first would have had to pull. */
static void press(const Work *w, int t, const Group *g) {
    for (int s = 0; s < w->slots; s++) {
        if (!w->active[t * w->slots + s]) continue;
        const Lanes *forces = g->state + w->states + s * NODES;
        ptrdiff_t at = w->slot[t * w->slots + s] * w->lanes + g->first;
        double *lowest = w->out[LOWEST - STATE] + at, *lost = w->out[LOST - STATE] + at;
        Lanes pull = forces[0];
        for (int k = 1; k < NODES; k++) pull = greater(forces[k], pull);
        store(lowest, less(-pull, load(lowest, g->many)), g->many);
        if (!any(pull > 0)) continue;
        Lanes when = load(lost, g->many);
        for (int k = 0; k < NODES; k++) {
            Lanes time = all(w->in[START][t] + w->in[SPAN][t] * w->in[GAUSS][k]);
            when = either(forces[k] > 0, less(time, when), when);
        }
        store(lost, when, g->many);
    }
}

/* The contact forces at the nodes of a step. */
static inline ALWAYS void meet(const Work *w, int t, const Step *step, const Group *g, int slots,
                               Lanes *matrix, Lanes *forces) {
    const int rows = slots * NODES;
    memset(forces, 0, (size_t)rows * sizeof *forces);
    add_product(forces, step->respond, rows, g->state, w->states);
    for (int s = 0; s < slots; s++) {
        ptrdiff_t at = w->slot[t * slots + s] * w->lanes + g->first;
        Lanes mass = {0}, weight = {0};
        if (w->active[t * slots + s]) {
            mass = load(w->in[INERTIA] + at, g->many);
            weight = load(w->in[WEIGHT] + at, g->many);
        }
        for (int i = s * NODES; i < (s + 1) * NODES; i++) {
            forces[i] = -(weight + mass * forces[i]);
            for (int j = 0; j < rows; j++) matrix[i * rows + j] = mass * step->gains[i * rows + j];
            matrix[i * rows + i] += 1;
        }
    }
    eliminate(matrix, forces, rows);
}

static void collocate(const Work *w, int t, const Step *step, const Group *g) {
    if (w->slots == 1) { /* in registers */
        Lanes matrix[NODES * NODES], forces[NODES];
        meet(w, t, step, g, 1, matrix, forces);
        memcpy(g->state + w->states, forces, sizeof forces);
    } else {
        meet(w, t, step, g, w->slots, g->matrix, g->state + w->states);
    }
}

/* Deflections at the points of a step, and the largest of them. */
static void watch(const Work *w, int t, const Step *step, const Group *g, int both) {
    Lanes *seen = g->samples + t * w->looked;
    memset(seen, 0, (size_t)w->looked * sizeof *seen);
    add_product(seen, step->seen, w->looked, g->state, w->states + (step->pressed ? w->rows : 0));
    for (int place = 0; place < w->places; place++) {
        Lanes high = {0}, largest = {0};
        for (int i = place; i < w->looked; i += w->places) {
            largest = greater(absolute(seen[i]), largest);
            if (!both) high = greater(seen[i], high);
        }
        high = both ? largest : high;
        g->high[t * w->places + place] = high;
        Lanes last = seen[w->looked - w->places + place];
        g->most[t * w->places + place] = most_within(seen[place], last, high, largest, both);
    }
}

/* The state at the end of a step; without forces, modes that are not coupled are two states each. */
static void move(const Work *w, const Step *step, Group *g) {
    const double *drift = step->drift;
    Lanes *state = g->state, *after = g->after;
    if (w->side == 2) {
        for (int i = 0; i < w->states; i += 2, drift += 4) {
            after[i] = drift[0] * state[i] + drift[2] * state[i + 1];
            after[i + 1] = drift[1] * state[i] + drift[3] * state[i + 1];
        }
    } else {
        memset(after, 0, (size_t)w->states * sizeof *after);
        for (int i = 0; i < w->states; i += w->side, drift += w->side * w->side)
            add_product(after + i, drift, w->side, state + i, w->side);
    }
    if (step->pressed) add_product(after, step->push, w->states, state + w->states, w->rows);
    g->state = after, g->after = state;
}

/* The peaks so far, from the samples of all steps. */
static void raise(const Work *w, const Step *steps, const Group *g, int place, int both) {
    const int many = g->many;
    const ptrdiff_t at = place * w->lanes + g->first, plane = (ptrdiff_t)w->places * w->lanes;
    const Lanes *seen = g->samples + place;
    Lanes before = load(w->out[SCORE - STATE] + at, many), least = before, score = before, top = {0};
    for (int t = 0; t < STEPS; t++)
        if (steps[t].taken) least = greater(g->high[t * w->places + place], least);
    for (int t = 0; t < STEPS; t++) {
        if (!steps[t].taken) continue;
        /* Only steps that may come above the highest of all samples can have the peak. */
        Lanes found = g->high[t * w->places + place];
        Mask maybe = g->most[t * w->places + place] > least;
        if (!any(maybe)) continue;
        Lanes samples[POINTS];
        for (int p = 0; p < POINTS; p++) samples[p] = seen[(t * POINTS + p) * w->places];
        if (any(maybe & rises_within(samples, w->ends, found, both)))
            found = vertex(samples, w->in[CURVE], w->in[LOOKED], both);
        top = either(found > score, all(t), top);
        score = greater(found, score);
    }
    Mask better = score > before;
    if (!any(better)) return;
    store(w->out[SCORE - STATE] + at, score, many);
    double *start = w->out[BEST_START - STATE] + at, *span = w->out[BEST_SPAN - STATE] + at;
    for (int t = 0; t < STEPS; t++) {
        Mask here = better & (top == all(t));
        if (!any(here)) continue;
        for (int p = 0; p < POINTS; p++) {
            double *kept = w->out[SAMPLES - STATE] + p * plane + at;
            store(kept, either(here, seen[(t * POINTS + p) * w->places], load(kept, many)), many);
        }
        store(start, either(here, all(w->in[START][t]), load(start, many)), many);
        store(span, either(here, all(w->in[SPAN][t]), load(span, many)), many);
    }
}

/* All steps of the chunk for a few groups of lanes, in turns: while one waits for its divisions, others
   have work. */
static inline ALWAYS void take(const Work *w, const Step *steps, Group *groups, int count, int both) {
    Group *end = groups + count;
    for (const Group *g = groups; g < end; g++)
        for (int i = 0; i < w->states; i++)
            g->state[i] = load(w->in[STATE] + i * w->lanes + g->first, g->many);
    for (int t = 0; t < STEPS; t++) {
        const Step *step = steps + t;
        if (!step->taken) continue;
        if (step->pressed) {
            for (const Group *g = groups; g < end; g++) collocate(w, t, step, g);
            for (const Group *g = groups; g < end; g++) press(w, t, g);
        }
        for (const Group *g = groups; g < end; g++) watch(w, t, step, g, both);
        for (Group *g = groups; g < end; g++) move(w, step, g);
    }
    for (const Group *g = groups; g < end; g++) {
        for (int place = 0; place < w->places; place++) raise(w, steps, g, place, both);
        Lanes nothing = {0}; /* unless a state is infinite or not a number, as it then stays */
        for (int i = 0; i < w->states; i++) {
            store(w->out[0] + i * w->lanes + g->first, g->state[i], g->many);
            nothing += 0 * g->state[i];
        }
        for (int l = 0; l < g->many; l++)
            w->sound[g->first + l] = w->sound_in[g->first + l] && nothing[l] == 0;
    }
}

static XLA_FFI_Error *fault(const XLA_FFI_CallFrame *frame, const char *message) {
    XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, message,
                                      XLA_FFI_Error_Code_INTERNAL};
    return frame->api->XLA_FFI_Error_Create(&args);
}

/* Whether XLA only asks for which version of its interface this was compiled; it is told. */
static int asked(XLA_FFI_CallFrame *frame) {
    if (!frame->extension_start || frame->extension_start->type != XLA_FFI_Extension_Metadata) return 0;
    XLA_FFI_Metadata *about = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
    about->api_version.major_version = XLA_FFI_API_MAJOR;
    about->api_version.minor_version = XLA_FFI_API_MINOR;
    return 1;
}

static inline ALWAYS XLA_FFI_Error *run(XLA_FFI_CallFrame *frame, int both) {
    if (asked(frame)) return NULL;
    if (frame->args.size != ARGUMENTS || frame->rets.size != KEPT + 1)
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
    memset(w->ends, 0, sizeof w->ends);
    for (int i = 1; i < POINTS; i++)
        for (int p = 0; p < POINTS; p++) {
            double slope = i * w->in[CURVE][p * POINTS + i]; /* of the power, at 1 */
            w->ends[p] += i % 2 ? slope : -slope;
            w->ends[POINTS + p] += slope;
        }
    XLA_FFI_Buffer *spare = frame->rets.rets[KEPT]; /* may begin anywhere */
    Lanes *scratch = (Lanes *)(((uintptr_t)spare->data + sizeof(Lanes) - 1) & -sizeof(Lanes));
    const size_t room = room_of(w);
    Step steps[STEPS];
    double *tables = (double *)(scratch + TURNS * room);
    for (int t = 0; t < STEPS; t++)
        tabulate(w, t, steps + t, scratch, tables + (size_t)t * tables_of(w));
    Group groups[TURNS];
    for (int k = 0; k < TURNS; k++) {
        Group *g = groups + k;
        g->state = scratch + (size_t)k * room, g->after = g->state + w->states + w->rows;
        g->matrix = g->after + w->states + w->rows;
        g->samples = g->matrix + w->rows * w->rows, g->high = g->samples + STEPS * w->looked;
        g->most = g->high + STEPS * w->places;
    }
    for (int64_t first = 0; first < w->lanes;) {
        int count = 0;
        for (; count < TURNS && first < w->lanes; count++, first += WIDE) {
            int64_t left = w->lanes - first;
            groups[count].first = first, groups[count].many = left < WIDE ? (int)left : WIDE;
        }
        take(w, steps, groups, count, both);
    }
    return NULL;
}

/* Where the curves through samples (point, curve) are largest. */
static inline ALWAYS XLA_FFI_Error *seek(XLA_FFI_CallFrame *frame, int both) {
    if (asked(frame)) return NULL;
    const XLA_FFI_Buffer *samples = frame->args.args[0], *through = frame->args.args[1];
    XLA_FFI_Buffer *places = frame->rets.rets[0];
    const int64_t count = samples->dims[1];
    for (int64_t first = 0; first < count; first += WIDE) {
        const int many = count - first < WIDE ? (int)(count - first) : WIDE;
        Lanes curve[POINTS];
        for (int p = 0; p < POINTS; p++)
            curve[p] = load((const double *)samples->data + p * count + first, many);
        store((double *)places->data + first, find(curve, through->data, both), many);
    }
    return NULL;
}

/* Deflections to both sides count, or only those upwards. */
XLA_FFI_Error *places_of_both_sides(XLA_FFI_CallFrame *frame) { return seek(frame, 1); }
XLA_FFI_Error *places_of_one_side(XLA_FFI_CallFrame *frame) { return seek(frame, 0); }
XLA_FFI_Error *chunk_of_both_sides(XLA_FFI_CallFrame *frame) { return run(frame, 1); }
XLA_FFI_Error *chunk_of_one_side(XLA_FFI_CallFrame *frame) { return run(frame, 0); }
