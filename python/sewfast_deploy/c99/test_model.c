    @_model model;
    int k, wrong = 0;
    @_init(&model);
    for (k = 0; k < @COUNT; k++) {
        wrong += @_step(&model, &u[k * @@_INPUTS]) != y[k];
    }
