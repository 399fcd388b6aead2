/* tanh(x) = x P(x^2)/Q(x^2), within 1e-15 of its size and never beyond +-1; two quotients, both in Estrin's form. */
static double @_tanh(double x)
{
    const double size = x < 0.0 ? -x : x;
    double s = x * x, s2, s4, p, q, t;
    if (size < @NEAR_END) {
        static const double n[8] = {@NEAR_P};
        static const double d[8] = {@NEAR_Q};
        s2 = s * s;
        s4 = s2 * s2;
        p = (x * n[0] + x * n[1] * s) + (x * n[2] + x * n[3] * s) * s2;
        p = p + ((x * n[4] + x * n[5] * s) + (x * n[6] + x * n[7] * s) * s2) * s4;
        q = (d[0] + d[1] * s) + (d[2] + d[3] * s) * s2;
        q = q + ((d[4] + d[5] * s) + (d[6] + d[7] * s) * s2) * s4;
        return p / q;
    } else {
        static const double n[11] = {@FAR_P};
        static const double d[11] = {@FAR_Q};
        double p_high, q_high;
        s = s > @FAR_END * @FAR_END ? @FAR_END * @FAR_END : s;
        s2 = s * s;
        s4 = s2 * s2;
        p = (n[0] + n[1] * s) + (n[2] + n[3] * s) * s2;
        p_high = (n[4] + n[5] * s) + (n[6] + n[7] * s) * s2;
        p_high = p_high + s4 * ((n[8] + n[9] * s) + n[10] * s2);
        q = (d[0] + d[1] * s) + (d[2] + d[3] * s) * s2;
        q_high = (d[4] + d[5] * s) + (d[6] + d[7] * s) * s2;
        q_high = q_high + s4 * ((d[8] + d[9] * s) + d[10] * s2);
        t = (x * p + x * s4 * p_high) / (q + s4 * q_high);
        t = t > 1.0 ? 1.0 : t;
        return t < -1.0 ? -1.0 : t;
    }
}
