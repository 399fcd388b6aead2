/* Kp, Kp Ts/Ti, Td in the form in which a step uses them. */
static @_terms @_terms_of(@_real kp, @_real ki, @_real td)
{
    const @_real filter = @FILTER;
    @_terms g;
    g.kp = kp;
    g.ki = ki;
    g.kd = kp * td / (filter + @STEP);
    g.pole = filter / (filter + @STEP);
    g.rate = kp * td;
    return g;
}

