/* As if the reference had been r for ever. */
static void @_stand_at(@_pid *c, @_real r)
{
    int i;
    for (i = 0; i < @@_KEPT; i++) {
        c->kept[i] = r;
    }
    c->ahead = 1;
    @_reset_filter(&c->of_kept);
}

/* Keeps a reference; one that is not finite repeats the last. Before the first one it was always the same. */
static void @_keep(@_pid *c, @_real r)
{
    if (c->ahead) {
        const @_real last = c->kept[c->newest];
        c->newest = c->newest + 1 < @@_KEPT ? c->newest + 1 : 0;
        c->kept[c->newest] = @_is_finite(r) ? r : last;
    } else if (@_is_finite(r)) {
        @_stand_at(c, r);
    }
}

/* The reference age samples before the newest. */
static @_real @_earlier(const @_pid *c, int age)
{
    const int place = c->newest - age;
    return c->kept[place < 0 ? place + @@_KEPT : place];
}

/* The measurement that is expected now: late as the measurement is, and through the same filter. */
static @_real @_expected(@_pid *c)
{
    const @_real now = @_earlier(c, @@_PREVIEW);
    const @_real before = @_earlier(c, @@_PREVIEW + 1);
    const @_real expected = @_filter(&c->of_kept, now + @LATE * (before - now));
    if (!@_is_finite(expected)) {
        @_reset_filter(&c->of_kept);
    }
    return expected;
}

@LEVELS/* What the model needs for the references so far. */
static @_real @_needed(const @_pid *c)
{
@NEEDED}

