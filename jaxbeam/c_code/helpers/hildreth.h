/* Minimise |z| subject to G z <= h, rows of G of length 1, by Hildreth's dual procedure; whether it
   is solved within a number of sweeps. Work: 2 rows + variables. */
static int hildreth(real *z, const real *G, const real *h, int rows, int variables, int sweeps,
                    real *work)
{
    const real tolerance = sizeof(real) < 8 ? (real)1e-6 : (real)1e-13;
    real *multipliers = work, *previous = work + rows, *sum = work + 2 * rows;
    int i, j, sweep, status = 0;
    for (i = 0; i < rows; i++) multipliers[i] = 0;
    for (j = 0; j < variables; j++) z[j] = 0;
    for (sweep = 0; sweep < sweeps && status == 0; sweep++) {
        real error = 0;
        copy(previous, multipliers, rows);
        for (i = 0; i < rows; i++) {
            const real *g = G + i * variables;
            real updated = multipliers[i] - h[i];
            for (j = 0; j < variables; j++) updated += g[j] * z[j];
            if (!(updated > 0)) updated = 0;
            for (j = 0; j < variables; j++) z[j] -= g[j] * (updated - multipliers[i]);
            multipliers[i] = updated;
        }
        for (j = 0; j < variables; j++) z[j] = 0;
        for (i = 0; i < rows; i++)
            for (j = 0; j < variables; j++) z[j] -= G[i * variables + j] * multipliers[i];
        for (i = 0; i < rows; i++) {
            real slack = h[i], worst;
            for (j = 0; j < variables; j++) slack -= G[i * variables + j] * z[j];
            worst = multipliers[i] < slack ? multipliers[i] : slack;
            if (-slack > worst) worst = -slack;
            if (!(worst <= error)) error = worst;
        }
        status = qp_status(tolerance, error, z, previous, multipliers, h, G, rows, variables, sum);
    }
    return status == 1;
}
