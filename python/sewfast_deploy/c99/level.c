/* The command that holds an output, the same for all of them. */
static @_real @_held(@_real y)
{
    return @U + (y - @Y) * R(0.0);
}

