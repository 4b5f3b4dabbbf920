/* result = values */
static void copy(real *result, const real *values, int count)
{
    int i;
    for (i = 0; i < count; i++) result[i] = values[i];
}
