
/* What proportional and derivative term change by, the integral term takes up; the derivative stands for the same rate. */
static void @_take(@_pid *c, @_terms g)
{
    const @_terms before = c->terms;
    if (c->started) {
        const @_real shown = c->e - @ALPHA * c->r;
        const @_real rescaled = before.rate != R(0.0) ? c->derivative * (g.rate / before.rate) : R(0.0);
        const @_real derivative = @_is_finite(rescaled) ? rescaled : R(0.0);
        const @_real proportional = before.kp * shown - g.kp * shown;
        c->integral = c->integral + (proportional + (c->derivative - derivative));
        c->derivative = derivative;
    }
    c->terms = g;
}

int @_set_gains(@_pid *c, @_real Kp, @_real Ti, @_real Td)
{
    if (!(@_is_finite(Kp) && Ti > R(0.0) && Td >= R(0.0) && @_is_finite(Td))) {
        return 0;
    }
    @_take(c, @_terms_of(Kp, Kp * @STEP / Ti, Td));
    return 1;
}

int @_set_limits(@_pid *c, @_real u_min, @_real u_max)
{
    if (!(u_min <= @LARGEST && u_max > u_min)) {
        return 0;
    }
    c->u_min = u_min;
    c->u_max = u_max;
    @_take(c, c->terms);
    if (!c->started && !c->held) {
        c->u = @_limit(R(0.0), u_min, u_max);
    }
    return 1;
}
