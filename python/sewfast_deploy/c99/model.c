void @_begin(@_model *model, const @_real *state, const @_real *held)
{
@BEGINS}

void @_init(@_model *model)
{
    static const @_real rest[@@_STATES] = {
        @REST
    };
    static const @_real held[@@_INPUTS] = {
        @HELD
    };
    @_begin(model, rest, held);
}

@_real @_step(@_model *model, const @_real *u)
{
@STEP}
