/* constant + of_inputs * v + of_states * x */
static @_real @m_affine(@_real constant, const @_real *of_inputs, const @_real *of_states, const @_real *x,
                        const @_real *u)
{
    int i;
    for (i = 0; i < @@_INPUTS; i++) {
        constant = constant + of_inputs[i] * u[i * @M_KEPT + @M_NK];
    }
    for (i = 0; i < @M_NX; i++) {
        constant = constant + of_states[i] * x[i];
    }
    return constant;
}

static @_real @m_beside(const @_real *weights, const @_real *h)
{
    @_real v[8] = {0};
    int i;
    for (i = 0; i < @M_HIDDEN; i++) {
        v[i % 8] = v[i % 8] + weights[i] * h[i];
    }
    return @_sum(v);
}

/* h = tanh(Wx x + Wu v + bh), x+ = A x + B v + E h, y = f(C x + D v + c + G h) */
static @_real @m_output(@_real *x, const @_real *u)
{
    @_real h[@M_HIDDEN], next[@M_NX], sum;
    int i;
    for (i = 0; i < @M_HIDDEN; i++) {
        h[i] = @_tanh(@m_affine(@m_bh[i], &@m_wu[i * @@_INPUTS], &@m_wx[i * @M_NX], x, u));
    }
    for (i = 0; i < @M_NX; i++) {
        next[i] = @m_affine(R(0.0), &@m_b[i * @@_INPUTS], &@m_a[i * @M_NX], x, u);
        next[i] = next[i] + @m_beside(&@m_e[i * @M_HIDDEN], h);
    }
    sum = @m_affine(@m_constant[0], @m_d, @m_c, x, u) + @m_beside(@m_g, h);
    for (i = 0; i < @M_NX; i++) {
        x[i] = next[i];
    }
    return @OUTPUT;
}
