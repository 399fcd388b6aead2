passed:
    if (c->ahead) {
        @_keep(c, @_ramp(c, r, r));
        @_expected(c);
    }
