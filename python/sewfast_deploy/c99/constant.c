    static const @_terms constant = {@TERMS};
    (void)y;
    return constant;
