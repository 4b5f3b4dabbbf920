/* Add deflections y above a threshold to the sums of `load_from_sums`: the position x is the one
   whose influence lines a explain most, (a y)^2 / a^2, refined by a parabola. */
static void add_deflections(real *sums, const real *lines, const real *squares, int sensors,
                            int positions, const real *y, real *explained, real t, real length,
                            real threshold)
{
    real size = 0, largest = 0, product, curvature, vertex = 0, weight, x;
    int i, j, best = 0;
    for (i = 0; i < sensors; i++) {
        size += y[i] * y[i];
        if (fabs(y[i]) > largest) largest = fabs(y[i]);
    }
    if (!(largest > threshold)) return;
    for (j = 0; j < positions; j++) {
        product = 0;
        for (i = 0; i < sensors; i++) product += lines[j * sensors + i] * y[i];
        explained[j] = squares[j] > 0 ? product * product / squares[j] : 0;
        if (explained[j] > explained[best]) best = j;
    }
    if (best < 1) best = 1;
    if (best > positions - 2) best = positions - 2;
    curvature = explained[best - 1] - 2 * explained[best] + explained[best + 1];
    if (curvature < 0) vertex = (explained[best - 1] - explained[best + 1]) / (2 * curvature);
    x = (best + (vertex < (real)-0.5 ? (real)-0.5 : vertex > (real)0.5 ? (real)0.5 : vertex))
        * length / (positions - 1);
    weight = size * size;
    product = 0;
    for (i = 0; i < sensors; i++) product += lines[best * sensors + i] * y[i];
    sums[0] += weight;
    sums[1] += weight * t;
    sums[2] += weight * t * t;
    sums[3] += weight * x;
    sums[4] += weight * t * x;
    sums[5] += product;
    sums[6] += squares[best];
    if (weight > sums[7]) sums[7] = weight;
}
