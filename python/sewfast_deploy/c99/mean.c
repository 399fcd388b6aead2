static @_real @_combined(const @_real *y)
{
    @_real sum = R(0.0);
    int i;
    for (i = 0; i < @COUNT; i++) {
        sum = sum + y[i];
    }
    return sum / R(@COUNT.0);
}

