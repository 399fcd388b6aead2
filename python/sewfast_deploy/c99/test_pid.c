    @_pid c;
    int k, wrong = 0;
    @_init(&c);
    for (k = 0; k < @COUNT; k++) {
@SWITCH        wrong += @_step(&c, r[k], y[k]) != u[k];
    }
