/* Minimise |z| subject to G z <= h, rows of G of length 1, by Mehrotra's predictor-corrector method,
   as jaxbeam does; whether it is solved within a number of steps.
   Work: variables x (variables + 4) + 10 rows. */
static int interior_point(real *z, const real *G, const real *h, int rows, int variables, int steps,
                          real *work)
{
    const real tolerance = sizeof(real) < 8 ? (real)2e-5 : (real)1e-12;
    const real regularisation = sizeof(real) < 8 ? (real)1e-7 : (real)1e-12;
    const int after_centring = 20;
    real *factor = work, *dz = factor + variables * variables, *stationary = dz + variables;
    real *sum = stationary + variables, *l = sum + 2 * variables, *s = l + rows, *dl = s + rows;
    real *ds = dl + rows, *limits = ds + rows, *scaling = limits + rows, *product = scaling + rows;
    real *rest = product + rows, *previous = rest + rows, *second = previous + rows;
    int i, j, step, status = 0;
    for (j = 0; j < variables; j++) z[j] = 0;
    for (i = 0; i < rows; i++) {
        l[i] = 1;
        s[i] = (h[i] > 0 ? h[i] : 0) + 1;
    }
    for (step = 0; step < steps && status == 0; step++) {
        const int centring = step > after_centring && step % 2 == 0;
        real gap = 0, affine_gap = 0, target, length, error;
        optimality_errors(stationary, limits, G, h, z, l, s, rows, variables);
        for (i = 0; i < rows; i++) {
            scaling[i] = 1 / (s[i] / l[i] + regularisation);
            product[i] = l[i] * s[i];
            gap += product[i];
        }
        factor_normal_matrix(factor, G, scaling, rows, variables);
        newton_step(dz, dl, ds, factor, G, scaling, stationary, limits, product, l, s, rows,
                    variables, sum, rest);
        length = step_length(l, dl, s, ds, rows, 1);
        for (i = 0; i < rows; i++)
            affine_gap += (l[i] + length * dl[i]) * (s[i] + length * ds[i]);
        target = affine_gap / gap;
        target = (centring ? (real)0.3 : target * target * target) * gap / rows;
        for (i = 0; i < rows; i++) {
            second[i] = (centring ? 0 : length) * dl[i] * ds[i];
            product[i] += second[i] - target;
        }
        newton_step(dz, dl, ds, factor, G, scaling, stationary, limits, product, l, s, rows,
                    variables, sum, rest);
        length = step_length(l, dl, s, ds, rows, (real)0.995);
        for (j = 0; j < variables; j++) z[j] += length * dz[j];
        for (i = 0; i < rows; i++) {
            previous[i] = l[i];
            s[i] += length * ds[i];
            l[i] += length * dl[i];
        }
        error = optimality_errors(stationary, limits, G, h, z, l, s, rows, variables);
        status = qp_status(tolerance, error, z, previous, l, h, G, rows, variables, sum);
    }
    return status == 1;
}
