/* The @NAME, by insertion. */
static @_real @_combined(@_real *y)
{
    int i, j;
    for (i = 1; i < @COUNT; i++) {
        const @_real own = y[i];
        for (j = i; j > 0 && y[j - 1] > own; j--) {
            y[j] = y[j - 1];
        }
        y[j] = own;
    }
    return @MIDDLE;
}

