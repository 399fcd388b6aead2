/* The sum of eight partial sums, in halves: the order in which a computer adds them. */
static @_real @_sum(const @_real v[8])
{
    return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
}
