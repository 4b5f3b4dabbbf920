/* Innovations of missing readings are zero. */
static void drop_missing(real *innovation, const real *present, int count)
{
    int i;
    for (i = 0; i < count; i++)
        if (!(present[i] > 0)) innovation[i] = 0;
}
