// Largest number of operations of a step of law.c over its recorded samples: numbers that count.
#include <cmath>
#include <cstdio>

struct counted {
    double value;
    static long operations;
    counted(double x = 0) : value(x) {}
    explicit operator int() const { return (int)value; }
    explicit operator double() const { return value; }
    counted operator-() const { return -value; }
    counted &operator+=(counted x) { return *this = *this + x; }
    counted &operator-=(counted x) { return *this = *this - x; }
    counted &operator*=(counted x) { return *this = *this * x; }
    counted &operator/=(counted x) { return *this = *this / x; }
#define BINARY(result, symbol) \
    friend result operator symbol(counted x, counted y) { return operations++, x.value symbol y.value; }
    BINARY(counted, +) BINARY(counted, -) BINARY(counted, *) BINARY(counted, /)
    BINARY(bool, <) BINARY(bool, >) BINARY(bool, <=) BINARY(bool, >=) BINARY(bool, ==) BINARY(bool, !=)
#define UNARY(name) \
    friend counted name(counted x) { return operations++, std::name(x.value); }
    UNARY(fabs) UNARY(sqrt) UNARY(exp) UNARY(sin) UNARY(cos) UNARY(tan) UNARY(log) UNARY(sinh)
    UNARY(cosh) UNARY(tanh) UNARY(expm1) UNARY(log1p) UNARY(floor) UNARY(ceil) UNARY(rint)
    friend counted pow(counted x, counted y) { return operations++, std::pow(x.value, y.value); }
    friend counted fmod(counted x, counted y) { return operations++, std::fmod(x.value, y.value); }
};
long counted::operations = 0;

#define LAW_REAL counted
#include "law.c"
#include "law_samples.h"

enum { INPUTS = LAW_SENSORS + LAW_GIVEN_STATES };

int main()
{
    static law_state state;
    real measurements[INPUTS + 1], commands[LAW_COMMANDS];
    long most = 0;
#ifdef GATED
    int event = 0;
#endif
    law_reset(&state);
    for (int k = 0; k < SAMPLES; k++) {
#ifdef GATED
        for (; event < GATE_EVENTS && gate_event[2 * event] <= sample_time[k]; event++)
            law_gate(&state, (int)gate_event[2 * event + 1], gate_event[2 * event]);
#endif
        for (int i = 0; i < INPUTS; i++) measurements[i] = sample_measurements[k * INPUTS + i];
        counted::operations = 0;
        law_step(&state, measurements, sample_time[k], commands);
        if (counted::operations > most) most = counted::operations;
    }
    std::printf("%ld\n", most);
}
