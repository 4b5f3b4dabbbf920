/* First move of generalised predictive control: outputs y(k+j) = -(A (1 - q)) y + B du, j up to a
   horizon, are led to a reference w by a number of moves.
   a, B: polynomials of a number of powers; y: readings, the latest first, powers + 1 of each output;
   du: past moves, the latest first. Work: (2 horizon + 1) outputs (1 + actuators) + n (n + 2) with
   n = moves x actuators. */
static void predictive_move(real *move, const real *a, const real *B, const real *y, const real *du,
                            int powers, int outputs, int actuators, int first, int horizon,
                            int moves, const real *weight, const real *move_weight, const real *w,
                            real *work)
{
    const int n = moves * actuators, size = outputs * actuators;
    real *free = work, *steps = free + horizon * outputs, *factor = steps + horizon * size;
    real *right = factor + n * n, *half = right + n;
    int i, j, k, o, p;
    for (j = 1; j <= horizon; j++) {
        for (o = 0; o < outputs; o++) {
            real sum = 0;
            for (i = 1; i <= powers + 1; i++) {
                const real one = (i <= powers ? a[i - 1] : 0) - (i > 1 ? a[i - 2] : 1);
                sum -= one * (j > i ? free[(j - i - 1) * outputs + o] : y[(i - j) * outputs + o]);
            }
            for (i = j + 1; i <= powers; i++)
                for (p = 0; p < actuators; p++)
                    sum += B[((i - 1) * outputs + o) * actuators + p] *
                           du[(i - j - 1) * actuators + p];
            free[(j - 1) * outputs + o] = sum;
        }
        for (o = 0; o < size; o++) {
            real sum = j <= powers ? B[(j - 1) * size + o] : 0;
            for (i = 1; i <= powers + 1 && i < j; i++) {
                const real one = (i <= powers ? a[i - 1] : 0) - (i > 1 ? a[i - 2] : 1);
                sum -= one * steps[(j - i - 1) * size + o];
            }
            steps[(j - 1) * size + o] = sum;
        }
    }
    for (i = 0; i < n; i++) {
        right[i] = 0;
        for (k = 0; k <= i; k++) factor[i * n + k] = i == k ? move_weight[i % actuators] : 0;
        for (j = first; j <= horizon; j++) {
            const int own = j - 1 - i / actuators;
            if (own < 0) continue;
            for (o = 0; o < outputs; o++) {
                const real weighted =
                    weight[o] * steps[(own * outputs + o) * actuators + i % actuators];
                right[i] += weighted * (w[o] - free[(j - 1) * outputs + o]);
                for (k = 0; k <= i; k++)
                    factor[i * n + k] +=
                        weighted * steps[((j - 1 - k / actuators) * outputs + o) * actuators +
                                         k % actuators];
            }
        }
    }
    for (i = 0; i < n; i++) {
        real sum = right[i];
        for (j = 0; j <= i; j++) {
            real entry = factor[i * n + j];
            for (k = 0; k < j; k++) entry -= factor[i * n + k] * factor[j * n + k];
            factor[i * n + j] = i == j ? sqrt(entry) : entry / factor[j * n + j];
        }
        for (k = 0; k < i; k++) sum -= factor[i * n + k] * half[k];
        half[i] = sum / factor[i * n + i];
    }
    for (i = n - 1; i >= 0; i--) {
        real sum = half[i];
        for (k = i + 1; k < n; k++) sum -= factor[k * n + i] * right[k];
        right[i] = sum / factor[i * n + i];
    }
    for (i = 0; i < actuators; i++) move[i] = right[i];
}
