/* Mode shapes at a position x (m) and their first and second derivatives, modes each, from
   Chebyshev series by order, segment, degree and mode; zero off the beam. */
static void mode_shapes(real *shapes, real x, const real *nodes, const real *series, int segments,
                        int degrees, int modes)
{
    const int on_beam = x >= nodes[0] && x <= nodes[segments];
    int i, order, degree, mode, segment = 0;
    real local;
    for (i = 0; i < 3 * modes; i++) shapes[i] = 0;
    if (!on_beam) return;
    for (i = 1; i < segments; i++)
        if (x >= nodes[i]) segment = i;
    local = 2 * (x - nodes[segment]) / (nodes[segment + 1] - nodes[segment]) - 1;
    for (order = 0; order < 3; order++)
        for (mode = 0; mode < modes; mode++) {
            const real *own = series + (order * segments + segment) * degrees * modes + mode;
            real last = 0, before = 0;
            for (degree = degrees - 1; degree > 0; degree--) {
                const real next = own[degree * modes] + 2 * local * last - before;
                before = last;
                last = next;
            }
            shapes[order * modes + mode] = own[0] + local * last - before;
        }
}
