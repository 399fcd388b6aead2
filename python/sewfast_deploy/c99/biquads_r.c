    if (@_is_finite(r)) {
        if (!c->r_begun) {
            @_rest_at(c->of_r, filtered);
        }
        r = @_through(c->of_r, r);
        c->r_begun = (unsigned char)@_is_finite(r);
    }
