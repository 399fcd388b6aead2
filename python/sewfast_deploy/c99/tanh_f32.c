/* tanh(x) = x P(x^2)/Q(x^2), within 3 units in the last place and never beyond +-1. */
static float @_tanh(float x)
{
    static const float n[5] = {@SINGLE_P};
    static const float d[5] = {@SINGLE_Q};
    float s = x * x, t;
    s = s > @SINGLE_END * @SINGLE_END ? @SINGLE_END * @SINGLE_END : s;
    t = x * (n[0] + s * (n[1] + s * (n[2] + s * (n[3] + s * n[4]))));
    t = t / (d[0] + s * (d[1] + s * (d[2] + s * (d[3] + s * d[4]))));
    t = t > R(1.0) ? R(1.0) : t;
    return t < R(-1.0) ? R(-1.0) : t;
}
