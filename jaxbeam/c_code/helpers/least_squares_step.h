/* Recursive least squares: coefficients and covariance P (over nothing but the noise's variance)
   after a number, row coefficients + noise. Work: count. */
static void least_squares_step(real *coefficients, real *P, const real *row, real number,
                               real variance, int count, real *spread)
{
    real error = number, size = variance;
    int i, j;
    for (i = 0; i < count; i++) {
        spread[i] = 0;
        for (j = 0; j < count; j++) spread[i] += P[i * count + j] * row[j];
        error -= row[i] * coefficients[i];
        size += row[i] * spread[i];
    }
    for (i = 0; i < count; i++) {
        const real gain = spread[i] / size;
        coefficients[i] += gain * error;
        for (j = 0; j < count; j++) P[i * count + j] -= gain * spread[j];
    }
}
