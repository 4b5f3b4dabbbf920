/* A and B of the beam under loads of some positions (m), speeds (m/s) and masses (kg), which are its
   last states; from those without loads, A0 and B0. A share of each mass follows the beam.
   Work: loads (4 modes + loads + commands + states). */
static void loaded_system(real *A, real *B, const real *A0, const real *B0, const real *position,
                          const real *speed, const real *mass, const real *share,
                          const real *nodes, const real *series, const int *coordinate,
                          const int *rate, const real *scale, real gravity, int states,
                          int commands, int modes, int loads, int segments, int degrees, real *work)
{
    real *shapes = work, *contact = shapes + 3 * loads * modes, *force = contact + loads * loads;
    real *of_states = force + loads * modes, *of_commands = of_states + loads * states;
    int i, j, k, c;
    copy(A, A0, states * states);
    copy(B, B0, states * commands);
    for (i = 0; i < loads; i++)
        mode_shapes(shapes + 3 * i * modes, position[i], nodes, series, segments, degrees, modes);
    for (i = 0; i < loads; i++) {
        const real *own = shapes + 3 * i * modes;
        const real inertia = share[i] * (mass[i] > 0 ? mass[i] : 0);
        for (c = 0; c < states; c++) {
            of_states[i * states + c] = 0;
            for (j = 0; j < modes; j++)
                of_states[i * states + c] += own[j] / scale[j] * A0[rate[j] * states + c];
        }
        for (j = 0; j < modes; j++) {
            of_states[i * states + coordinate[j]] +=
                speed[i] * speed[i] * own[2 * modes + j] / scale[j];
            of_states[i * states + rate[j]] += 2 * speed[i] * own[modes + j] / scale[j];
        }
        for (c = 0; c < states; c++) of_states[i * states + c] *= inertia;
        for (c = 0; c < commands; c++) {
            of_commands[i * commands + c] = 0;
            for (j = 0; j < modes; j++)
                of_commands[i * commands + c] +=
                    inertia * own[j] / scale[j] * B0[rate[j] * commands + c];
        }
        for (j = 0; j < modes; j++) force[i * modes + j] = own[j];
        for (k = 0; k < loads; k++) {
            const real other = share[k] * (mass[k] > 0 ? mass[k] : 0);
            real product = 0;
            for (j = 0; j < modes; j++) product += own[j] * shapes[3 * k * modes + j];
            contact[i * loads + k] = (i == k) + other * product;
        }
    }
    /* Elimination: the matrix is similar to a positive definite one. */
    for (k = 0; k < loads; k++)
        for (i = 0; i < loads; i++) {
            const real factor = contact[i * loads + k] / contact[k * loads + k];
            if (i == k) continue;
            for (c = k; c < loads; c++) contact[i * loads + c] -= factor * contact[k * loads + c];
            for (j = 0; j < modes; j++) force[i * modes + j] -= factor * force[k * modes + j];
        }
    for (i = 0; i < loads; i++)
        for (j = 0; j < modes; j++) {
            const real own = scale[j] * force[i * modes + j] / contact[i * loads + i];
            for (c = 0; c < states; c++)
                A[rate[j] * states + c] -= own * of_states[i * states + c];
            for (c = 0; c < commands; c++)
                B[rate[j] * commands + c] -= own * of_commands[i * commands + c];
            A[rate[j] * states + states - loads + i] -= own * gravity;
        }
}
