/* Two points of a grid and their weights, for the interpolation at x; or the nearest point. */
static void grid_weights(const real *grid, int points, real x, int nearest, int *index,
                         real *weight)
{
    int i = interval(grid, points, x), k;
    real fraction = 0;
    if (i + 1 < points && x > grid[i]) fraction = (x - grid[i]) / (grid[i + 1] - grid[i]);
    if (nearest) {
        for (i = 0, k = 1; k < points; k++)
            if (fabs(grid[k] - x) < fabs(grid[i] - x)) i = k;
        fraction = 0;
    }
    index[0] = i;
    index[1] = i + 1 < points ? i + 1 : i;
    weight[0] = 1 - fraction;
    weight[1] = fraction;
}
