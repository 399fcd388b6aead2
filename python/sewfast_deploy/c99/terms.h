typedef struct @_terms {
    @_real kp, ki, kd, pole@RATE;
} @_terms;

