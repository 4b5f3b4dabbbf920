/* The nearest number to x between two limits; the lower one for what is no number. */
static real clamp(real x, real low, real high)
{
    return !(x >= low) ? low : x > high ? high : x;
}
