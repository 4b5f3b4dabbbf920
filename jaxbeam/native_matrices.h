/* Small matrices of several runs side by side, and what C functions called by XLA share.

   An array of XLA's has the runs, its lanes, as its last axis, of length one where they share it. */

#include <stdlib.h>

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

static inline void fetch(Lanes *to, const Array *from, int64_t start, int64_t count, Span span) {
    for (int64_t i = 0; i < count; i++) to[i] = entry(from, start + i, span);
}

static inline void keep(double *to, int64_t index, Lanes lanes, Span span) {
    store(to + index * span.all + span.first, lanes, span.many);
}

/* A part of the products of rows of `left` with rows of `right`: as many sums as registers hold. */
static inline ALWAYS void tile(Lanes *sums, int width, const Lanes *left, const Lanes *right, int terms,
                               int down, int across) {
    Lanes sum[16];
#pragma GCC unroll 4
    for (int i = 0; i < down; i++)
#pragma GCC unroll 4
        for (int j = 0; j < across; j++) sum[i * 4 + j] = sums[i * width + j];
    for (int k = 0; k < terms; k++) {
#pragma GCC unroll 4
        for (int i = 0; i < down; i++)
#pragma GCC unroll 4
            for (int j = 0; j < across; j++)
                sum[i * 4 + j] += left[i * terms + k] * right[j * terms + k];
    }
#pragma GCC unroll 4
    for (int i = 0; i < down; i++)
#pragma GCC unroll 4
        for (int j = 0; j < across; j++) sums[i * width + j] = sum[i * 4 + j];
}

static inline ALWAYS void strip(Lanes *sums, int width, const Lanes *left, const Lanes *right,
                                int columns, int terms, int down) {
    int j = 0;
    for (; j + 4 <= columns; j += 4) tile(sums + j, width, left, right + j * terms, terms, down, 4);
    if (j + 2 <= columns) {
        tile(sums + j, width, left, right + j * terms, terms, down, 2);
        j += 2;
    }
    if (j < columns) tile(sums + j, width, left, right + j * terms, terms, down, 1);
}

/* How many rows are taken at a time, of those that are left. */
static inline int taken(int left) { return left >= 4 ? 4 : left >= 2 ? 2 : 1; }

/* sums += left right' for one to four rows of `left`, as `taken` has it. */
static void few_rows(Lanes *sums, int width, const Lanes *left, const Lanes *right, int columns,
                     int terms, int rows) {
    if (rows == 4) strip(sums, width, left, right, columns, terms, 4);
    else if (rows == 2) strip(sums, width, left, right, columns, terms, 2);
    else strip(sums, width, left, right, columns, terms, 1);
}

/* sums += left right': both are given by rows of so many terms, the sums by rows of `columns`. */
static void add_dots(Lanes *sums, const Lanes *left, int rows, const Lanes *right, int columns,
                     int terms) {
    for (int i = 0, step; i < rows; i += step) {
        step = taken(rows - i);
        few_rows(sums + i * columns, columns, left + i * terms, right, columns, terms, step);
    }
}

static inline void dots(Lanes *sums, const Lanes *left, int rows, const Lanes *right, int columns,
                        int terms) {
    memset(sums, 0, (size_t)(rows * columns) * sizeof *sums);
    add_dots(sums, left, rows, right, columns, terms);
}

/* sums += shares right: `right` by its rows of so many columns. */
static void add_rows(Lanes *sums, const Lanes *shares, int rows, const Lanes *right, int terms,
                     int columns) {
    for (int i = 0; i < rows; i++)
        for (int k = 0; k < terms; k++)
            for (int j = 0; j < columns; j++)
                sums[i * columns + j] += shares[i * terms + k] * right[k * columns + j];
}

static XLA_FFI_Error *fault(const XLA_FFI_CallFrame *frame, const char *message) {
    XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, message,
                                      XLA_FFI_Error_Code_INTERNAL};
    return frame->api->XLA_FFI_Error_Create(&args);
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

static double *result(const XLA_FFI_CallFrame *frame, int64_t *lanes) {
    const XLA_FFI_Buffer *buffer = frame->rets.rets[0];
    *lanes = buffer->dims[buffer->rank - 1];
    return buffer->data;
}

static Lanes *numbers(size_t count) { return aligned_alloc(sizeof(Lanes), count * sizeof(Lanes)); }
