/* Peaks and contact forces of many tasks by hand: what integrate.march does for rigs without a driver.

   Steps are taken in chunks. What depends on the path alone is worked out first; lanes are then taken in
   groups that fill a vector register, and a few groups go through all steps of the chunk before the next
   begin, so that their states stay where they are worked on. native.py compiles this file and gives the
   arguments. */

#include "native_steps.h"

/* How much memory a call works in, in numbers. It is XLA's, a result that nobody reads: to allocate it in
   every call would take long. */
int64_t march_room(int64_t panels, int64_t blocks, int64_t side, int64_t modes, int64_t segments, int64_t terms,
                   int64_t slots, int64_t loads, int64_t places, int64_t lanes) {
    Work w = {.panels = (int)panels, .blocks = (int)blocks, .side = (int)side, .modes = (int)modes,
              .segments = (int)segments, .terms = (int)terms, .slots = (int)slots, .loads = (int)loads,
              .places = (int)places, .lanes = lanes};
    complete(&w);
    return (int64_t)((share(&w, 0) + sizeof(Lanes)) / 8);
}

/* All is at rest, and nothing seen. */
static void begin(Work *w) {
    const size_t lanes = (size_t)w->lanes, seen = (size_t)w->places * lanes;
    memset(w->state, 0, 8 * (size_t)w->states * lanes);
    memset(w->samples, 0, 8 * POINTS * seen);
    memset(w->score, 0, 8 * seen), memset(w->start, 0, 8 * seen), memset(w->span, 0, 8 * seen);
    for (size_t i = 0; i < (size_t)w->loads * lanes; i++) w->lowest[i] = w->lost[i] = INFINITY;
    for (size_t i = 0; i < lanes; i++) w->sound[i] = 1;
}

/* The steps of the next chunk. Those of a panel, of which some are done, are all alike. */
static int chunk(Work *w, int *panel, int64_t *done) {
    int count = 0;
    while (count < STEPS && *panel < w->panels) {
        if (*done >= steps_of(w, *panel)) {
            ++*panel, *done = 0;
            continue;
        }
        Step *step = w->steps + count++;
        step->panel = *panel, step->span = w->in[LENGTHS][*panel];
        step->start = w->in[EDGES][*panel] + (double)(*done)++ * step->span;
        step->drift = w->drift + (size_t)*panel * drift_of(w);
        step->loads = 0;
        const uint8_t *active = (const uint8_t *)w->in[ACTIVE] + *panel * w->loads;
        for (int l = 0; l < w->loads && step->loads < w->slots; l++)
            if (active[l]) step->load[step->loads++] = l;
        step->rows = step->loads * NODES;
        tabulate(w, step);
    }
    return count;
}

/* After this no load is on the beam. */
static double last_exit(const Work *w) {
    double last = 0;
    for (int l = 0; l < w->loads; l++) last = fmax(last, w->in[WINDOWS][2 * l + 1]);
    return last;
}

static void run(Work *w) {
    begin(w), shape_series(w), sights(w, (double *)w->product), propagators(w);
    const double exit = last_exit(w);
    int panel = 0;
    int64_t done = 0;
    for (int count; (count = chunk(w, &panel, &done));) {
        for (ptrdiff_t first = 0; first < w->lanes;) {
            int turns = 0;
            for (; turns < TURNS && first < w->lanes; turns++, first += WIDE) {
                w->groups[turns].first = first;
                w->groups[turns].many = w->lanes - first < WIDE ? (int)(w->lanes - first) : WIDE;
            }
            take(w, count, w->groups, turns);
        }
        const Step *last = w->steps + count - 1;
        if (last->start + last->span >= exit && spent(w)) break;
    }
}

/* Results of a task, with lanes first. */
static void report(const Work *w, int64_t task) {
    const ptrdiff_t lanes = w->lanes, plane = w->places * lanes;
    const ptrdiff_t seen = task * plane, pressed = task * w->loads * lanes;
    for (int place = 0; place < w->places; place++)
        for (ptrdiff_t first = 0; first < lanes; first += WIDE) {
            const int many = lanes - first < WIDE ? (int)(lanes - first) : WIDE;
            const ptrdiff_t at = place * lanes + first;
            Lanes samples[POINTS];
            for (int p = 0; p < POINTS; p++) samples[p] = load(w->samples + p * plane + at, many);
            const Curve curve = curve_through(samples, w->in[CURVE]);
            const Lanes where = find(&curve), peak = size_at(&curve, where);
            const Lanes time = load(w->start + at, many) + (where + 1) / 2 * load(w->span + at, many);
            for (int l = 0; l < many; l++) {
                const ptrdiff_t to = seen + (first + l) * w->places + place;
                w->out[PEAK][to] = w->sound[first + l] ? peak[l] : NAN;
                w->out[PEAK_TIME][to] = w->sound[first + l] ? time[l] : NAN;
            }
        }
    for (int load = 0; load < w->loads; load++)
        for (ptrdiff_t l = 0; l < lanes; l++) {
            const double lost = w->lost[load * lanes + l];
            w->out[LOWEST][pressed + l * w->loads + load] = w->lowest[load * lanes + l];
            w->out[LOST][pressed + l * w->loads + load] = lost < INFINITY ? lost : NAN;
        }
}

/* Slopes at both ends of the curve through samples. */
static void slopes(Work *w) {
    memset(w->ends, 0, sizeof w->ends);
    for (int i = 1; i < POINTS; i++)
        for (int p = 0; p < POINTS; p++) {
            double slope = i * w->in[CURVE][p * POINTS + i]; /* of the power, at 1 */
            w->ends[p] += i % 2 ? slope : -slope;
            w->ends[POINTS + p] += slope;
        }
}

static XLA_FFI_Error *fault(const XLA_FFI_CallFrame *frame, const char *message) {
    XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, message,
                                      XLA_FFI_Error_Code_INTERNAL};
    return frame->api->XLA_FFI_Error_Create(&args);
}

XLA_FFI_Error *march(XLA_FFI_CallFrame *frame) {
    if (asked(frame)) return NULL;
    if (frame->args.size != ARGUMENTS || frame->rets.size != RESULTS)
        return fault(frame, "jaxbeam's kernel is of another version than jaxbeam: build it anew");
    const int64_t *dims[ARGUMENTS];
    for (int i = 0; i < ARGUMENTS; i++) dims[i] = ((XLA_FFI_Buffer *)frame->args.args[i])->dims;
    XLA_FFI_Buffer **results = (XLA_FFI_Buffer **)frame->rets.rets;
    Work work = {
        .panels = (int)dims[COUNTS][1], .blocks = (int)dims[STATE_MATRIX][1],
        .side = (int)dims[STATE_MATRIX][2], .modes = (int)(dims[SERIES][3] / dims[STATE_MATRIX][1]),
        .segments = (int)dims[SERIES][1], .terms = (int)dims[SERIES][2], .pieces = (int)dims[SINCE][2],
        .slots = (int)*(const int64_t *)((const XLA_FFI_Scalar *)frame->attrs.attrs[0])->value,
        .loads = (int)dims[INERTIA][1], .places = (int)dims[PLACES][1], .lanes = dims[INERTIA][2],
    }, *w = &work;
    complete(w);
    for (int i = 0; i < RESULTS; i++) w->out[i] = results[i]->data;
    share(w, (uintptr_t)memory(frame, ROOM));
    const int64_t tasks = results[PEAK]->dims[0];
    for (int64_t task = 0; task < tasks; task++) {
        give(w, frame, task);
        if (task == 0) slopes(w);
        if (*(const uint8_t *)w->in[WANTED]) run(w);
        else begin(w);
        report(w, task);
    }
    return NULL;
}
