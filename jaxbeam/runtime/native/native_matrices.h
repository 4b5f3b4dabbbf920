/* Small matrices of several runs side by side, and what C functions called by XLA share.

   An array of XLA's has the runs, its lanes, as its last axis, of length one where they share it. */

#include "native_lanes.h"
#include "xla/ffi/api/c_api.h"

typedef struct {
    const double *data;
    const int64_t *dims;
    int64_t lanes;
} Array;

/* Which lanes are worked on: from `first` on, as many as are there, of all. */
typedef struct {
    int64_t first, all;
    int many;
} Span;

static inline Span span_of(int64_t first, int64_t lanes) {
    return (Span){first, lanes, lanes - first < WIDE ? (int)(lanes - first) : WIDE};
}

static inline Lanes entry(const Array *from, int64_t index, Span span) {
    if (from->lanes == 1) return all(from->data[index]);
    return load(from->data + index * from->lanes + span.first, span.many);
}

static inline void fetch(Lanes *to, const Array *from, int64_t start, int count, Span span) {
    const double *first = from->data + start * from->lanes;
    if (from->lanes == 1)
        for (int i = 0; i < count; i++) to[i] = all(first[i]);
    else if (span.many == WIDE)
        for (int i = 0; i < count; i++) to[i] = whole(first + i * span.all + span.first);
    else
        for (int i = 0; i < count; i++) to[i] = load(first + i * span.all + span.first, span.many);
}

static inline void keep(double *to, int64_t index, Lanes lanes, Span span) {
    store(to + index * span.all + span.first, lanes, span.many);
}

/* Where the numbers of a matrix are: how far rows lie apart, and entries of a row. */
typedef struct {
    const void *data;
    ptrdiff_t down, along;
} Matrix;

/* What kind of numbers: of each lane in a register, or in an array of XLA's, of which all lanes share
   them, or whole registers are there, or not. */
enum { REGISTERS, SHARED, OWN, PARTLY };

static inline ALWAYS Lanes number(const Matrix *matrix, ptrdiff_t i, ptrdiff_t k, Span span, int kind) {
    const ptrdiff_t at = i * matrix->down + k * matrix->along;
    if (kind == REGISTERS) return ((const Lanes *)matrix->data)[at];
    const double *from = (const double *)matrix->data;
    if (kind == SHARED) return all(from[at]);
    return load(from + at * span.all + span.first, kind == OWN ? WIDE : span.many);
}

/* sums = left right', or what is added to them, for a few rows of both: sums stay in registers. */
static inline ALWAYS void tile(Lanes *sums, ptrdiff_t width, Matrix left, Matrix right, int terms,
                               int rows, int columns, Span span, int kind, int add) {
    Lanes sum[16];
#pragma GCC unroll 4
    for (int i = 0; i < rows; i++)
#pragma GCC unroll 4
        for (int j = 0; j < columns; j++) sum[i * 4 + j] = add ? sums[i * width + j] : (Lanes){0};
    for (int k = 0; k < terms; k++) {
        Lanes with[4];
#pragma GCC unroll 4
        for (int j = 0; j < columns; j++) with[j] = number(&right, j, k, span, REGISTERS);
#pragma GCC unroll 4
        for (int i = 0; i < rows; i++) {
            const Lanes one = number(&left, i, k, span, kind);
#pragma GCC unroll 4
            for (int j = 0; j < columns; j++) sum[i * 4 + j] += one * with[j];
        }
    }
#pragma GCC unroll 4
    for (int i = 0; i < rows; i++)
#pragma GCC unroll 4
        for (int j = 0; j < columns; j++) sums[i * width + j] = sum[i * 4 + j];
}

static inline Matrix below(Matrix matrix, ptrdiff_t rows) {
    matrix.data = (const Lanes *)matrix.data + rows * matrix.down;
    return matrix;
}

static inline ALWAYS void strip(Lanes *sums, ptrdiff_t width, Matrix left, Matrix right, int columns,
                                int terms, int rows, Span span, int kind, int add) {
    int j = 0;
    for (; j + 4 <= columns; j += 4)
        tile(sums + j, width, left, below(right, j), terms, rows, 4, span, kind, add);
    const int rest = columns - j;
    sums += j, right = below(right, j);
    if (rest == 3) tile(sums, width, left, right, terms, rows, 3, span, kind, add);
    if (rest == 2) tile(sums, width, left, right, terms, rows, 2, span, kind, add);
    if (rest == 1) tile(sums, width, left, right, terms, rows, 1, span, kind, add);
}

/* How many rows are taken at a time, of those that are left. */
static inline int taken(int left) { return left < 4 ? left : 4; }

/* sums = left right', or added to them, for as many rows of `left` as are `taken` at a time. */
static inline ALWAYS void some_rows(Lanes *sums, ptrdiff_t width, Matrix left, int rows, Matrix right,
                                    int columns, int terms, Span span, int kind, int add) {
    if (rows == 4) strip(sums, width, left, right, columns, terms, 4, span, kind, add);
    else if (rows == 3) strip(sums, width, left, right, columns, terms, 3, span, kind, add);
    else if (rows == 2) strip(sums, width, left, right, columns, terms, 2, span, kind, add);
    else strip(sums, width, left, right, columns, terms, 1, span, kind, add);
}

/* The same where `left` is a part of an array, whose entry `first` is the first of its own. */
static void array_rows(Lanes *sums, ptrdiff_t width, const Array *from, int64_t first, Matrix left,
                       int rows, Matrix right, int columns, int terms, Span span, int add) {
    left.data = from->data + first * from->lanes;
    if (from->lanes == 1) {
        if (add) some_rows(sums, width, left, rows, right, columns, terms, span, SHARED, 1);
        else some_rows(sums, width, left, rows, right, columns, terms, span, SHARED, 0);
    } else if (span.many == WIDE) {
        if (add) some_rows(sums, width, left, rows, right, columns, terms, span, OWN, 1);
        else some_rows(sums, width, left, rows, right, columns, terms, span, OWN, 0);
    } else {
        some_rows(sums, width, left, rows, right, columns, terms, span, PARTLY, add);
    }
}

static void few_rows(Lanes *sums, ptrdiff_t width, Matrix left, int rows, Matrix right, int columns,
                     int terms) {
    some_rows(sums, width, left, rows, right, columns, terms, (Span){0}, REGISTERS, 1);
}

/* sums += left right'. */
static void add_products(Lanes *sums, ptrdiff_t width, Matrix left, int rows, Matrix right, int columns,
                         int terms) {
    for (int i = 0, step; i < rows; i += step) {
        step = taken(rows - i);
        few_rows(sums + i * width, width, below(left, i), step, right, columns, terms);
    }
}

/* sums += left right', both given row by row. */
static inline void add_dots(Lanes *sums, const Lanes *left, int rows, const Lanes *right, int columns,
                            int terms) {
    add_products(sums, columns, (Matrix){left, terms, 1}, rows, (Matrix){right, terms, 1}, columns,
                 terms);
}

/* sums = left right', both given row by row. */
static void dots(Lanes *sums, const Lanes *left, int rows, const Lanes *right, int columns, int terms) {
    for (int i = 0, step; i < rows; i += step) {
        step = taken(rows - i);
        some_rows(sums + i * columns, columns, (Matrix){left + i * terms, terms, 1}, step,
                  (Matrix){right, terms, 1}, columns, terms, (Span){0}, REGISTERS, 0);
    }
}

/* sums += shares right, all given row by row. */
static inline void add_shares(Lanes *sums, const Lanes *shares, int rows, const Lanes *right, int terms,
                            int columns) {
    add_products(sums, columns, (Matrix){shares, terms, 1}, rows, (Matrix){right, 1, columns}, columns,
                 terms);
}

/* XLA asks for which version of its interface this was compiled. */
static int asked(const XLA_FFI_CallFrame *frame) {
    if (!frame->extension_start || frame->extension_start->type != XLA_FFI_Extension_Metadata)
        return 0;
    XLA_FFI_Metadata *about = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
    about->api_version.major_version = XLA_FFI_API_MAJOR;
    about->api_version.minor_version = XLA_FFI_API_MINOR;
    return 1;
}

static void arrays(Array *to, const XLA_FFI_CallFrame *frame, int count) {
    for (int i = 0; i < count; i++) {
        const XLA_FFI_Buffer *buffer = frame->args.args[i];
        to[i] = (Array){buffer->data, buffer->dims, buffer->dims[buffer->rank - 1]};
    }
}

/* A result, and how many lanes it has. */
static double *result(const XLA_FFI_CallFrame *frame, int which, int64_t *lanes) {
    const XLA_FFI_Buffer *buffer = frame->rets.rets[which];
    *lanes = buffer->dims[buffer->rank - 1];
    return buffer->data;
}

/* The last result is memory to work in, from the first place on where registers may be kept. */
static Lanes *memory(const XLA_FFI_CallFrame *frame, int which) {
    const uintptr_t start = (uintptr_t)((const XLA_FFI_Buffer *)frame->rets.rets[which])->data;
    return (Lanes *)((start + sizeof(Lanes) - 1) / sizeof(Lanes) * sizeof(Lanes));
}

/* Some of the memory that a function works in: so many numbers of each lane. */
typedef struct {
    Lanes **start;
    int count;
} Room_part;

/* How many numbers the parts are; they are told where they start, if there is memory for them. */
static int64_t divide(const Room_part *parts, int count, Lanes *memory) {
    int64_t total = 0;
    for (int i = 0; i < count; total += parts[i++].count)
        if (memory) *parts[i].start = memory + total;
    return (total + 1) * WIDE; /* one for the place where it starts */
}
