    static const @_real taps[@COUNT] = {
        @TABLE
    };
    @_real sum = R(0.0), newer = c->kept[c->newest];
    int i;
    for (i = 0; i < @COUNT; i++) {
        const @_real older = @_earlier(c, i + 1);
        sum = sum + taps[i] * (newer - older);
        newer = older;
    }
    return @SUM;
