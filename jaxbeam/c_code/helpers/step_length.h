/* Length, at most 1, at which no multiplier or slack decreases by more than a share of itself. */
static real step_length(const real *l, const real *dl, const real *s, const real *ds, int rows,
                        real share)
{
    real worst = 0;
    int i;
    for (i = 0; i < rows; i++) {
        if (-dl[i] / l[i] > worst) worst = -dl[i] / l[i];
        if (-ds[i] / s[i] > worst) worst = -ds[i] / s[i];
    }
    return worst > share ? share / worst : 1;
}
