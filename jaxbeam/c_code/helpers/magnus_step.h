/* Transition of scaled states and held inputs over a span (s), E, and the covariance G of noise of
   an intensity N, by Magnus' method of order 4 from the matrices early and late at its Gauss nodes.
   Without noise G is left. Work: 4 size x size. */
static void magnus_step(real *E, real *G, const real *early, const real *late, const real *N,
                        real span, int with_noise, int size, int terms, int doublings, real *work)
{
    const int entries = size * size;
    const real offset = span * (real)0.28867513459481287;
    real *M = work, *noise = M + entries, *product = noise + entries, *other = product + entries;
    real part = 1;
    int i, j, k;
    for (k = 0; k < doublings; k++) part /= 2;
    matrix_product(product, late, early, size, size, size);
    matrix_product(other, early, late, size, size, size);
    for (i = 0; i < entries; i++)
        M[i] = part * span * ((early[i] + late[i]) / 2 + offset / 2 * (product[i] - other[i]));
    if (with_noise) {
        for (i = 0; i < entries; i++) other[i] = late[i] - early[i];
        matrix_product(product, other, N, size, size, size);
        for (i = 0; i < size; i++)
            for (j = 0; j < size; j++) {
                const real change = product[i * size + j] + product[j * size + i];
                noise[i * size + j] = part * span * (N[i * size + j] + offset / 2 * change);
                G[i * size + j] = noise[i * size + j];
            }
    }
    for (i = 0; i < entries; i++) E[i] = i % (size + 1) == 0;
    for (k = terms; k > 0; k--) {
        matrix_product(product, M, E, size, size, size);
        for (i = 0; i < entries; i++) E[i] = (i % (size + 1) == 0) + product[i] / k;
        if (!with_noise) continue;
        matrix_product(product, M, G, size, size, size);
        for (i = 0; i < size; i++)
            for (j = 0; j < size; j++)
                G[i * size + j] = noise[i * size + j] +
                                  (product[i * size + j] + product[j * size + i]) / (k + 1);
    }
    for (k = 0; k < doublings; k++) {
        if (with_noise) {
            matrix_product(product, E, G, size, size, size);
            for (i = 0; i < size; i++)
                for (j = 0; j < size; j++) {
                    real sum = 0;
                    int l;
                    for (l = 0; l < size; l++) sum += product[i * size + l] * E[j * size + l];
                    G[i * size + j] += sum;
                }
        }
        matrix_product(product, E, E, size, size, size);
        copy(E, product, entries);
    }
}
