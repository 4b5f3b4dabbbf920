/* Lags of a creep after a period in which a command acted; their share of what acts is returned. */
static real creep_after(const real *kept, const real *shares, int count, real *lags, real command)
{
    real sum = 0;
    int i;
    for (i = 0; i < count; i++) {
        lags[i] = command + (lags[i] - command) * kept[i];
        sum += shares[i] * lags[i];
    }
    return sum;
}
