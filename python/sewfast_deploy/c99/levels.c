/* The command that holds an output: linear between its levels, and on the same line beyond the ends. */
static @_real @_held(@_real y)
{
    /* output and command */
    static const @_real levels[@COUNT][2] = {
        @TABLE
    };
    const @_real *low = levels[0], *high = levels[1];
    int i;
    for (i = 1; i < @COUNT - 1; i++) {
        if (y >= levels[i][0]) {
            low = levels[i];
            high = levels[i + 1];
        }
    }
    return low[1] + (y - low[0]) * (high[1] - low[1]) / (high[0] - low[0]);
}

