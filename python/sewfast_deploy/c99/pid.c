@TERMS_TYPEstatic int @_is_finite(@_real x)
{
    return x - x == R(0.0);
}

/* NaN stays NaN. */
static @_real @_limit(@_real x, @_real low, @_real high)
{
    const @_real raised = x < low ? low : x;
    return raised > high ? high : raised;
}

@GAINS_OF
/* Mean of the last samples, then a lag@FILTER_WORDS. */
static @_real @_filter(@MEMORY *c, @_real y)
{
    @_real sum = R(0.0), from;
    int i;
    if (!c->averaging) {
        for (i = 0; i < @@_SAMPLES; i++) {
            c->samples[i] = y;
        }
    }
    c->averaging = 1;
    c->samples[c->next] = y;
    c->next = c->next + 1 < @@_SAMPLES ? c->next + 1 : 0;
    for (i = 0; i < @@_SAMPLES; i++) {
        sum = sum + c->samples[i];
    }
    y = sum / (@_real)@@_SAMPLES;
    from = c->lagging ? c->lag : y;
    c->lag = from + @LAG * (y - from);
    c->lagging = 1;
    y = c->lag;
@OBSERVER    return y;
}

@BIQUADSstatic void @_reset_filter(@MEMORY *c)
{
    c->averaging = 0;
    c->next = 0;
    c->lagging = 0;
    c->observing = 0;
}

/* The reference moves no faster than its ramp, from the measured output on. */
static @_real @_ramp(@_pid *c, @_real r, @_real start)
{
@FROM    if (!@_is_finite(r)) {
        return r;
    }
    c->ramped = @RAMPED;
    c->ramping = 1;
    return c->ramped;
}

/* The one way to the command: within the limits, no further from the last one than slew allows, and finite. */
static @_real @_limited(const @_pid *c, @_real wanted)
{
    const @_real u = @LIMITED;
    return @_is_finite(u) ? u : c->u;
}

/* A sample without measurement: command and memory stay; in manual the command is still the operator's. */
static @_real @_hold(@_pid *c)
{
@HELD    if (c->manual) {
        const @_real u = @_limited(c, c->operator_u);
        c->integral = c->integral + (u - c->u);
        c->u = u;
    }
    return c->u;
}

@AHEADvoid @_init(@_pid *c)
{
@INIT    @_reset_filter(@WITHIN);
    c->ramping = 0;
    c->integral = R(0.0);
    c->derivative = R(0.0);
    c->r = R(0.0);
    c->e = R(0.0);
    c->u = @_limit(R(0.0), @U_MIN, @U_MAX);
    c->operator_u = R(0.0);
    c->filtered = R(0.0);
    c->manual = 0;
    c->started = 0;
}

@_real @_step(@_pid *c, @_real r, @_real y)
{
    return @_step_with(c, r, y, R(-0.0));
}

@_real @_step_with(@_pid *c, @_real r, @_real y, @_real feedforward)
{
    @_terms g;
    @_real filtered, e, rate_input, change, derivative, integral, proportional, wanted, excess, kept;
    if (!@_is_finite(y)) {
        goto @PASS;
    }
    filtered = @_filter(@WITHIN, y);
    if (!@_is_finite(filtered)) {
        @_reset_filter(@WITHIN);
        goto @PASS;
    }
@OF_Y    c->filtered = filtered;
    r = @_ramp(c, r, filtered);
@OF_AHEAD@OF_R    g = @GAINS_NOW;
    e = r - filtered;
    rate_input = e - @BETA * r;
    change = rate_input - (c->e - @BETA * c->r);
    change = c->started ? change : R(0.0);
    derivative = g.pole * c->derivative + g.kd * change;
    integral = c->integral + g.ki * e;
    proportional = g.kp * (e - @ALPHA * r);
    wanted = proportional + integral + derivative + feedforward;
    if (!(@_is_finite(wanted) && @_is_finite(rate_input))) {
        if (@_is_finite(rate_input) && @_is_finite(feedforward)) {
            /* the memory is to blame: begin again at this sample */
            c->r = r;
            c->e = e;
            c->started = 1;
            c->derivative = R(0.0);
            if (!@_is_finite(c->integral)) {
                c->integral = c->u;
            }
        }
        goto held;
    }
    c->u = @_limited(c, c->manual ? c->operator_u : wanted);
    excess = c->u - wanted;
    kept = integral;
    if (excess != R(0.0) && g.ki != R(0.0)) {
@WINDUP
    }
    c->integral = c->manual ? c->u - proportional - derivative - feedforward : kept;
    c->derivative = derivative;
    c->r = r;
    c->e = e;
    c->started = 1;
    return c->u;
@PASSEDheld:
    return @_hold(c);
}

int @_set_manual(@_pid *c, @_real u)
{
    if (!@_is_finite(u)) {
        return 0;
    }
    c->operator_u = u;
    c->manual = 1;
    return 1;
}

void @_set_automatic(@_pid *c)
{
    c->manual = 0;
}
@CHANGES