/* Status of an iterate of a quadratic program: 1 solved, -1 no point obeys all limits, by the growth
   of the multipliers (Farkas), 0 neither. Work: variables. */
static int qp_status(real tolerance, real error, const real *z, const real *previous,
                     const real *multipliers, const real *h, const real *G, int rows,
                     int variables, real *work)
{
    const real certificate = sizeof(real) < 8 ? (real)1e-5 : (real)1e-12;
    const real max_distance = sizeof(real) < 8 ? (real)1e4 : (real)1e8;
    real size = 0, ray_sum = 0, ray_limit = 0, ray_size = 0;
    int i, j;
    for (j = 0; j < variables; j++) {
        if (!(fabs(z[j]) <= size)) size = fabs(z[j]);
        work[j] = 0;
    }
    if (error <= tolerance * (1 + size)) return 1;
    for (i = 0; i < rows; i++) {
        const real ray = multipliers[i] > previous[i] ? multipliers[i] - previous[i] : 0;
        if (!(ray > 0)) continue;
        ray_sum += ray;
        ray_limit -= h[i] * ray;
        for (j = 0; j < variables; j++) work[j] += G[i * variables + j] * ray;
    }
    for (j = 0; j < variables; j++)
        if (!(fabs(work[j]) <= ray_size)) ray_size = fabs(work[j]);
    return ray_limit > max_distance * ray_size + certificate * ray_sum ? -1 : 0;
}
