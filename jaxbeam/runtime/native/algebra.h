/* Powers and small matrices, of NUMBERs that SQUARE_ROOT, ZERO and ONE are of. The file is included
 * once for each kind of number; exported programs have its text. */

static inline NUMBER NAMED(power)(NUMBER base, int exponent) {
    NUMBER product = ONE;
    for (int n = abs(exponent); n; n /= 2, base = base * base)
        if (n % 2) product = product * base;
    return exponent < 0 ? 1 / product : product;
}

/* Lower Cholesky factor of a matrix by its lower half; NaN of one that is not positive. */
static inline void NAMED(factor)(NUMBER *factor, const NUMBER *matrix, int size) {
    for (int i = 0; i < size; i++)
        for (int j = 0; j < size; j++) {
            NUMBER sum = matrix[i * size + j];
            if (j > i) {
                factor[i * size + j] = ZERO;
                continue;
            }
            for (int k = 0; k < j; k++) sum -= factor[i * size + k] * factor[j * size + k];
            factor[i * size + j] = i == j ? SQUARE_ROOT(sum) : sum / factor[j * size + j];
        }
}

/* Solve a triangular system in place, of so many right sides; steps between the rows of them, and
 * between these. A unit diagonal is not read. */
static inline void NAMED(eliminate)(NUMBER *right, int row_step, int step, int count,
                                    const NUMBER *matrix, int size, int lower, int transposed,
                                    int unit) {
    const int down = lower != transposed;
    for (int n = 0; n < size; n++) {
        const int i = down ? n : size - 1 - n;
        for (int c = 0; c < count; c++) {
            NUMBER sum = right[i * row_step + c * step];
            for (int m = 0; m < n; m++) {
                const int j = down ? m : size - 1 - m;
                sum -= matrix[transposed ? j * size + i : i * size + j] *
                       right[j * row_step + c * step];
            }
            right[i * row_step + c * step] = unit ? sum : sum / matrix[i * size + i];
        }
    }
}
