/* Output of a sum of play operators, whose plays follow a command. */
static real plays_output(const real *thresholds, const real *weights, int count, real *plays,
                         real command)
{
    real sum = 0;
    int i;
    for (i = 0; i < count; i++) {
        plays[i] = clamp(plays[i], command - thresholds[i], command + thresholds[i]);
        sum += weights[i] * plays[i];
    }
    return sum;
}
