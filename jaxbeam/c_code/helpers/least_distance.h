/* Limits h of the least-distance form from their values at the origin of the variables, and the
   unconstrained minimiser z0: h -= G z0, over the largest violation, which is returned; 0 if z0
   is within the limits. */
static real least_distance(real *h, const real *G, const real *z0, int rows, int variables)
{
    const real rounding = sizeof(real) < 8 ? (real)1e-6 : (real)1e-13;
    real violation = 0, magnitude = 0, largest = 0;
    int i;
    for (i = 0; i < rows; i++)
        if (fabs(h[i]) > magnitude) magnitude = fabs(h[i]);
    for (i = 0; i < variables; i++)
        if (fabs(z0[i]) > largest) largest = fabs(z0[i]);
    multiply_add(h, -1, G, z0, rows, variables);
    for (i = 0; i < rows; i++)
        if (-h[i] > violation) violation = -h[i];
    if (violation <= rounding * (magnitude + largest)) return 0;
    for (i = 0; i < rows; i++) h[i] /= violation;
    return violation;
}
