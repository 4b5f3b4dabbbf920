/* Lower Cholesky factor of I + G' diag(scaling) G. */
static void factor_normal_matrix(real *factor, const real *G, const real *scaling, int rows,
                                 int variables)
{
    int i, j, k;
    for (i = 0; i < variables; i++) {
        for (j = 0; j <= i; j++) {
            real sum = i == j;
            for (k = 0; k < rows; k++)
                sum += scaling[k] * G[k * variables + i] * G[k * variables + j];
            for (k = 0; k < j; k++) sum -= factor[i * variables + k] * factor[j * variables + k];
            factor[i * variables + j] = i == j ? sqrt(sum) : sum / factor[j * variables + j];
        }
    }
}
