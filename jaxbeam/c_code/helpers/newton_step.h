/* Changes of z, of the multipliers l and of the slacks s for a product of l and s to remove. */
static void newton_step(real *dz, real *dl, real *ds, const real *factor, const real *G,
                        const real *scaling, const real *stationary, const real *limits,
                        const real *product, const real *l, const real *s, int rows,
                        int variables, real *half, real *rest)
{
    int i, j;
    for (j = 0; j < variables; j++) half[j] = -stationary[j];
    for (i = 0; i < rows; i++) {
        rest[i] = scaling[i] * (limits[i] - product[i] / l[i]);
        for (j = 0; j < variables; j++) half[j] -= G[i * variables + j] * rest[i];
    }
    for (i = 0; i < variables; i++) {
        for (j = 0; j < i; j++) half[i] -= factor[i * variables + j] * half[j];
        half[i] /= factor[i * variables + i];
    }
    for (i = variables - 1; i >= 0; i--) {
        dz[i] = half[i];
        for (j = i + 1; j < variables; j++) dz[i] -= factor[j * variables + i] * dz[j];
        dz[i] /= factor[i * variables + i];
    }
    for (i = 0; i < rows; i++) {
        real sum = 0;
        for (j = 0; j < variables; j++) sum += G[i * variables + j] * dz[j];
        dl[i] = rest[i] + scaling[i] * sum;
        ds[i] = -(product[i] + s[i] * dl[i]) / l[i];
    }
}
