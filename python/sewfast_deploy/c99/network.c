/* bias + weights * [past outputs, inputs], the newest output last. */
static @_real @m_affine(@_real bias, const @_real *weights, const @_real *y, const @_real *u)
{
    int i, j;
    for (j = @@_INPUTS - 1; j >= 0; j--) {
        for (i = @M_NB - 1; i >= 0; i--) {
            bias = bias + weights[@M_NA + j * @M_NB + i] * u[j * @M_KEPT + @M_NK + i];
        }
    }
    for (i = @M_NA - 1; i >= 0; i--) {
        bias = bias + weights[i] * y[i];
    }
    return bias;
}

/* y(k) = b2 + direct phi + sum w2(i) tanh(b1(i) + w1(i) phi), held within its limits */
static @_real @m_output(@_real *y, const @_real *u)
{
    @_real v[8] = {0}, sum;
    int i;
    v[0] = @m_affine(@m_b2[0], @m_direct, y, u);
    for (i = 0; i < @M_HIDDEN; i++) {
        const @_real z = @m_affine(@m_b1[i], &@m_w1[i * (@M_NA + @@_INPUTS * @M_NB)], y, u);
        v[i % 8] = v[i % 8] + @m_w2[i] * @_tanh(z);
    }
    sum = @_sum(v);
@LIMITS    @_push(y, @M_NA, sum);
    return sum;
}
