/* Whether all numbers are finite, with room to square them in double precision. */
static int all_finite(const real *values, int count)
{
    int i;
    for (i = 0; i < count; i++)
        if (!(fabs(values[i]) <= (real)1e30)) return 0;
    return 1;
}
