/* Calls by XLA's foreign function interface (FFI). */

#pragma once

#include "registers.h"
#include "xla/ffi/api/c_api.h"

/* Whether XLA only asks for the version of the FFI, which is then answered. */
static int answer_version_query(const XLA_FFI_CallFrame *frame) {
    if (!frame->extension_start || frame->extension_start->type != XLA_FFI_Extension_Metadata)
        return 0;
    XLA_FFI_Metadata *metadata = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
    metadata->api_version.major_version = XLA_FFI_API_MAJOR;
    metadata->api_version.minor_version = XLA_FFI_API_MINOR;
    return 1;
}

static XLA_FFI_Error *ffi_error(const XLA_FFI_CallFrame *frame, const char *message) {
    XLA_FFI_Error_Create_Args args = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, message,
                                      XLA_FFI_Error_Code_INTERNAL};
    return frame->api->XLA_FFI_Error_Create(&args);
}

/* Memory of a result, from its first address at which a register can be stored. */
static Register *aligned_memory(const XLA_FFI_CallFrame *frame, int result) {
    const uintptr_t start = (uintptr_t)((const XLA_FFI_Buffer *)frame->rets.rets[result])->data;
    return (Register *)((start + sizeof(Register) - 1) / sizeof(Register) * sizeof(Register));
}
