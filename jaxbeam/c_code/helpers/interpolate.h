/* Linear interpolation in a table of values over an ascending grid; held beyond the ends. */
static real interpolate(real x, const real *grid, const real *values, int points)
{
    const int i = interval(grid, points, x);
    if (x <= grid[0]) return values[0];
    if (i + 1 >= points) return values[points - 1];
    return values[i] + (x - grid[i]) * ((values[i + 1] - values[i]) / (grid[i + 1] - grid[i]));
}
