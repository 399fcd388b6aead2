/* log(1 + e^z) = max(z, 0) + log(1 + e^-|z|); the second logarithm as 2 artanh(q), by its series. */
static @_real @_softplus(@_real z)
{
    const @_real t = @_tanh(R(0.5) * (z < R(0.0) ? -z : z));
    const @_real e = (R(1.0) - t) / (R(1.0) + t);
    const @_real q = e / (R(1.0) + R(1.0) + e), square = q * q;
    @_real sum = R(0.0), positive = z > R(0.0) ? z : R(0.0);
    int i;
    for (i = 17; i >= 0; i--) {
        sum = R(1.0) / (@_real)(2 * i + 1) + square * sum;
    }
    positive = z - z == R(0.0) ? positive : z;
    return positive + (q + q) * sum;
}

/* Limits with soft corners, in the form of the nearer one. */
static @_real @_saturated(@_real s, @_real low, @_real high, @_real width)
{
    const int lower = s < low + R(0.5) * (high - low);
    const @_real first = lower ? s - low : low - s, second = lower ? s - high : high - s;
    return (lower ? low : high) + width * (@_softplus(first / width) - @_softplus(second / width));
}
