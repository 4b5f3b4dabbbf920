/* Which readings are present: numbers between the lowest and the highest; they replace the last. */
static void receive(real *readings, real *present, const real *measurements, const real *lowest,
                    const real *highest, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        present[i] = measurements[i] >= lowest[i] && measurements[i] <= highest[i];
        if (present[i] > 0) readings[i] = measurements[i];
    }
}
