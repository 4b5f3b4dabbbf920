/* Triangular factors of a matrix in place, and the order of its rows, by the largest pivots. There is
 * a step between entries: those of one run in registers. */
static inline void decompose(Lane *matrix, Place *order, Place *swapped, int size, int step) {
    for (int i = 0; i < size; i++) order[i * step] = i;
    for (int k = 0; k < size; k++) {
        int best = k;
        for (int i = k + 1; i < size; i++)
            if (fabs(matrix[(i * size + k) * step]) > fabs(matrix[(best * size + k) * step]))
                best = i;
        swapped[k * step] = best;
        if (best != k) {
            const Place row = order[k * step];
            order[k * step] = order[best * step], order[best * step] = row;
            for (int j = 0; j < size; j++) {
                const Lane entry = matrix[(k * size + j) * step];
                matrix[(k * size + j) * step] = matrix[(best * size + j) * step];
                matrix[(best * size + j) * step] = entry;
            }
        }
        for (int i = k + 1; i < size; i++) {
            const Lane share = matrix[(i * size + k) * step] /= matrix[(k * size + k) * step];
            for (int j = k + 1; j < size; j++)
                matrix[(i * size + j) * step] -= share * matrix[(k * size + j) * step];
        }
    }
}
