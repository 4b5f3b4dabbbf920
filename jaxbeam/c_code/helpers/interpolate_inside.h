/* Linear interpolation in a table of values over an ascending grid; zero beyond the ends. */
static real interpolate_inside(real x, const real *grid, const real *values, int points)
{
    if (x < grid[0] || x > grid[points - 1]) return 0;
    return interpolate(x, grid, values, points);
}
