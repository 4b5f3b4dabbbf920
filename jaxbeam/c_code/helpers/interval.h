/* Index of the last point of an ascending grid that is not above x; 0 below the grid. */
static int interval(const real *grid, int points, real x)
{
    int low = 0, high = points;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (grid[middle] <= x) low = middle;
        else high = middle;
    }
    return low;
}
