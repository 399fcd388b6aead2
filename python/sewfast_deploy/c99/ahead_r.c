    @_keep(c, r);
    if (c->ahead) {
        r = @_expected(c);
        feedforward = feedforward + @_needed(c);
    }
