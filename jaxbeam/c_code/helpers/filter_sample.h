/* Output of a digital filter for a sample: sections b0, b1, b2, 1, a1, a2, two states each. */
static real filter_sample(const real *sections, int count, real *states, real sample)
{
    int i;
    for (i = 0; i < count; i++) {
        const real *c = sections + 6 * i;
        real *s = states + 2 * i;
        const real output = c[0] * sample + s[0];
        s[0] = c[1] * sample - c[4] * output + s[1];
        s[1] = c[2] * sample - c[5] * output;
        sample = output;
    }
    return sample;
}
