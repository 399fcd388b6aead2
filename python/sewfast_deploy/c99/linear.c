/* y(k) = -sum a(i) y(k-1-i) + sum b(j nb + i) u_j(k-nk-i) + offset */
static @_real @m_output(@_real *y, const @_real *u)
{
    @_real sum = @m_offset[0];
    int i, j;
    for (j = 0; j < @@_INPUTS; j++) {
        for (i = 0; i < @M_NB; i++) {
            sum = sum + @m_b[j * @M_NB + i] * u[j * @M_KEPT + @M_NK + i];
        }
    }
    for (i = 0; i < @M_NA; i++) {
        sum = sum - @m_a[i] * y[i];
    }
    @_push(y, @M_NA, sum);
    return sum;
}
