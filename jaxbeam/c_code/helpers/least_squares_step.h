/* Recursive least squares: coefficients and a square root S of their covariance S S' after a number,
   row coefficients + noise of a standard deviation. Work: 2 count. */
static void least_squares_step(real *coefficients, real *S, const real *row, real number,
                               real deviation, int count, real *work)
{
    real *along = work, *spread = work + count;
    real error = number, size = deviation * deviation, scale;
    int i, j;
    for (i = 0; i < count; i++) {
        along[i] = 0;
        for (j = 0; j < count; j++) along[i] += S[j * count + i] * row[j];
        error -= row[i] * coefficients[i];
        size += along[i] * along[i];
    }
    multiply(spread, S, along, count, count);
    scale = size + deviation * sqrt(size);
    for (i = 0; i < count; i++) {
        coefficients[i] += spread[i] / size * error;
        for (j = 0; j < count; j++) S[i * count + j] -= spread[i] * (along[j] / scale);
    }
}
