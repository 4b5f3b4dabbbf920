/* result = matrix x vector, the matrix row after row. */
static void multiply(real *result, const real *matrix, const real *vector, int rows, int columns)
{
    int i, j;
    for (i = 0; i < rows; i++) {
        real sum = 0;
        for (j = 0; j < columns; j++) sum += matrix[i * columns + j] * vector[j];
        result[i] = sum;
    }
}
