/* y |y|^(power - 1) */
static real power_law(real y, int power)
{
    const real magnitude = fabs(y);
    while (--power > 0) y *= magnitude;
    return y;
}
