/* Add -weight K x to commands u; each gain is a polynomial in the share within an interval between
   breakpoints of the share of the crossing. */
static void add_scheduled_command(real *u, real weight, const real *breakpoints,
                                  const real *polynomials, int intervals, int powers, real share,
                                  const real *x, int rows, int columns)
{
    const int size = rows * columns, k = interval(breakpoints, intervals, share);
    const real length = breakpoints[k + 1] - breakpoints[k];
    const real *p = polynomials + k * powers * size;
    const real f = clamp((share - breakpoints[k]) / (length > 0 ? length : 1), 0, 1);
    int i, j, n;
    for (i = 0; i < rows; i++) {
        real sum = 0;
        for (j = 0; j < columns; j++) {
            real gain = p[(powers - 1) * size + i * columns + j];
            for (n = powers - 2; n >= 0; n--) gain = gain * f + p[n * size + i * columns + j];
            sum += gain * x[j];
        }
        u[i] -= weight * sum;
    }
}
