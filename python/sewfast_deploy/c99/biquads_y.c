    if (!c->y_begun) {
        @_rest_at(c->of_y, filtered);
    }
    filtered = @_through(c->of_y, filtered);
    c->y_begun = (unsigned char)@_is_finite(filtered);
    if (!c->y_begun) {
        goto @PASS;
    }
