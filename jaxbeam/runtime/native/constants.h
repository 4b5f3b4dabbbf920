/* Numbers of the integrator in Python, written here too because wheels are compiled where there is no
 * JAX: tests/simulation/integrator/test_native_peaks.py compares them. */

#pragma once

#define PADDING 8
#define CHUNK_STEPS 16
#define NODES 6
#define TAYLOR_TERMS 14
#define DOUBLINGS 7
#define PEAK_POINTS 8
#define FORCE_POINTS 15
#define FORCE_GAP 0.1193095930415985
#define ZERO_ITERATIONS 4
#define SPREAD_FACTOR 1.8744032696202308
#define PEAK_MARGIN 1.1
#define END_PEAK_MARGIN 0.002002299488896503
#define NEWTON_STEP_LIMIT 0.15907945738879795
#define ESTIMATE_ITERATIONS 2
#define START_POINTS 17
#define NEWTON_ITERATIONS 6
#define TIE_TOLERANCE 1.7763568394002505e-15
