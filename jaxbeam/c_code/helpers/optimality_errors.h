/* Errors z + G'l of stationarity, G z + s - h of the limits; the largest of them and of the smaller
   of each multiplier l and slack s. */
static real optimality_errors(real *stationary, real *limits, const real *G, const real *h,
                              const real *z, const real *l, const real *s, int rows,
                              int variables)
{
    real worst = 0;
    int i, j;
    copy(stationary, z, variables);
    for (i = 0; i < rows; i++) {
        const real *g = G + i * variables;
        const real smaller = l[i] < s[i] ? l[i] : s[i];
        const real size = fabs(h[i]) > 1 ? (real)fabs(h[i]) : 1; /* rounded in proportion */
        limits[i] = s[i] - h[i];
        for (j = 0; j < variables; j++) {
            limits[i] += g[j] * z[j];
            stationary[j] += g[j] * l[i];
        }
        if (!(fabs(limits[i]) <= worst * size)) worst = fabs(limits[i]) / size;
        if (!(smaller <= worst)) worst = smaller;
    }
    for (j = 0; j < variables; j++)
        if (!(fabs(stationary[j]) <= worst)) worst = fabs(stationary[j]);
    return worst;
}
