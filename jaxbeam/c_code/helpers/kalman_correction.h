/* Correction of states x and their covariance P (Joseph's form) by an innovation of readings, rows x
   + noise of a variance each. Work: readings (2 states + readings) + states (3 states + readings). */
static void kalman_correction(real *x, real *P, const real *rows, const real *variance,
                              const real *innovation, int readings, int states, real *work)
{
    real *spread = work, *factor = spread + readings * states;
    real *gain = factor + readings * readings, *error = gain + states * readings;
    real *product = error + states * states, *transposed = product + states * states;
    int i, j, k;
    matrix_product(spread, rows, P, readings, states, states);
    for (i = 0; i < readings; i++)
        for (j = 0; j <= i; j++) {
            real sum = i == j ? variance[i] : 0;
            for (k = 0; k < states; k++) sum += spread[i * states + k] * rows[j * states + k];
            for (k = 0; k < j; k++) sum -= factor[i * readings + k] * factor[j * readings + k];
            factor[i * readings + j] = i == j ? sqrt(sum) : sum / factor[j * readings + j];
        }
    for (j = 0; j < states; j++) {
        for (i = 0; i < readings; i++) {
            real sum = spread[i * states + j];
            for (k = 0; k < i; k++) sum -= factor[i * readings + k] * gain[j * readings + k];
            gain[j * readings + i] = sum / factor[i * readings + i];
        }
        for (i = readings - 1; i >= 0; i--) {
            real sum = gain[j * readings + i];
            for (k = i + 1; k < readings; k++)
                sum -= factor[k * readings + i] * gain[j * readings + k];
            gain[j * readings + i] = sum / factor[i * readings + i];
        }
    }
    matrix_product(error, gain, rows, states, readings, states);
    for (i = 0; i < states * states; i++) error[i] = (i % (states + 1) == 0) - error[i];
    matrix_product(product, error, P, states, states, states);
    for (i = 0; i < states; i++)
        for (j = 0; j < states; j++) transposed[i * states + j] = error[j * states + i];
    matrix_product(P, product, transposed, states, states, states);
    for (i = 0; i < states; i++)
        for (j = 0; j <= i; j++) {
            real sum = (P[i * states + j] + P[j * states + i]) / 2;
            for (k = 0; k < readings; k++)
                sum += gain[i * readings + k] * variance[k] * gain[j * readings + k];
            P[i * states + j] = P[j * states + i] = sum;
        }
    multiply_add(x, 1, gain, innovation, states, readings);
}
