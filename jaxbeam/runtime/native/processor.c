/* Which of the libraries of a wheel this processor runs. */

#include "registers.h"

#if defined __x86_64__
#include <cpuid.h>

/* Whether it has the instructions of x86-64-v3 that the compiler takes, and the operating system
 * keeps the wide registers. */
EXPORTED int runs_x86_64_v3(void) {
    enum { FMA = 1 << 12, MOVBE = 1 << 22, OSXSAVE = 1 << 27, AVX = 1 << 28, F16C = 1 << 29 };
    enum { BMI1 = 1 << 3, AVX2 = 1 << 5, BMI2 = 1 << 8, LZCNT = 1 << 5, WIDE_REGISTERS = 6 };
    const unsigned first = FMA | MOVBE | OSXSAVE | AVX | F16C, seventh = BMI1 | AVX2 | BMI2;
    unsigned a, b, c, d, kept, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || (c & first) != first) return 0;
    __asm__("xgetbv" : "=a"(kept), "=d"(high) : "c"(0));
    if ((kept & WIDE_REGISTERS) != WIDE_REGISTERS) return 0;
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (b & seventh) != seventh) return 0;
    return __get_cpuid(0x80000001, &a, &b, &c, &d) && (c & LZCNT);
}
#else
EXPORTED int runs_x86_64_v3(void) { return 0; }
#endif
