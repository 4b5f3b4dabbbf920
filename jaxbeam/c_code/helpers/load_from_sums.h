/* Mass, speed, entry time of a load, and whether they are identified, from the sums of w, w t, w t t,
   w x, w t x, a y and a a over the samples, and the largest w: x over t is a straight line. */
static void load_from_sums(real *load, const real *sums, real t, real length, real travel,
                           real samples, real until, real gravity)
{
    const real variance = sums[0] * sums[2] - sums[1] * sums[1];
    int determined = variance > (real)1e-9 * sums[0] * sums[2];
    real speed = determined ? (sums[0] * sums[4] - sums[1] * sums[3]) / variance : 0;
    real entry = 0;
    determined = determined && speed * speed * variance > travel * sums[0] * (travel * sums[0])
                 && sums[0] > samples * sums[7];
    if (determined) entry = sums[1] / sums[0] + ((speed < 0 ? length : 0) - sums[3] / sums[0]) / speed;
    else speed = length;
    load[0] = (sums[6] > 0 ? sums[5] / sums[6] : 0) / gravity;
    load[1] = speed;
    load[2] = entry;
    load[3] = load[4] = determined && (t - entry) * fabs(speed) >= until;
}
