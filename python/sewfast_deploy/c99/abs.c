/* sqrt(a^2 + b^2): the larger one times the root of a number from 1 to 2, by Newton's method. */
static @_real @_hypotenuse(@_real a, @_real b)
{
    @_real large, small, ratio, x, root;
    int i;
    a = a < R(0.0) ? -a : a;
    b = b < R(0.0) ? -b : b;
    large = a < b ? b : a;
    small = a < b ? a : b;
    ratio = large > R(0.0) && large - large == R(0.0) ? small / large : R(0.0);
    x = R(1.0) + ratio * ratio;
    root = R(42.0) / R(100.0) + R(59.0) / R(100.0) * x;
    for (i = 0; i < 4; i++) {
        root = R(0.5) * (root + x / root);
    }
    return large * root;
}
