/* Sections of second order in series, 1 + (1 - q)(c0 + c1 q)/(1 + a1 q + a2 q^2) with q a delay of one sample. */
static const @_real @_sections[@@_BIQUADS][4] = {
    @SECTIONS
};

static void @_rest_at(@_biquad *memory, @_real x)
{
    int i;
    for (i = 0; i < @@_BIQUADS; i++) {
        memory[i].x = x;
        memory[i].s1 = R(0.0);
        memory[i].s2 = R(0.0);
    }
}

/* Transposed direct form II on the change of the input: at rest all memory is 0, and the gain is 1. */
static @_real @_through(@_biquad *memory, @_real x)
{
    int i;
    for (i = 0; i < @@_BIQUADS; i++) {
        const @_real *section = @_sections[i];
        const @_real change = x - memory[i].x;
        const @_real d = section[0] * change + memory[i].s1;
        memory[i].x = x;
        memory[i].s1 = section[1] * change - section[2] * d + memory[i].s2;
        memory[i].s2 = -(section[3] * d);
        x = x + d;
    }
    return x;
}

