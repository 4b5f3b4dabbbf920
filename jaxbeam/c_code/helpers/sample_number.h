/* Number of the sample at a time, from 0 to count - 1. */
static int sample_number(real t, real period, int count)
{
    const real number = t / period + (real)0.5;
    if (number < 1) return 0;
    return number < count ? (int)number : count - 1;
}
