static void @m_begin_member(@m_memory *model, const @_real *state, const @_real *held)
{
    int i, j;
    for (i = 0; i < @M_NA; i++) {
        model->state[i] = @BEGIN_STATE;
    }
    for (j = 0; j < @@_INPUTS; j++) {
        for (i = 0; i < @M_KEPT; i++) {
            model->waiting[j * @M_KEPT + i] = @SCALED(held[j]);
        }
    }
}

static @_real @m_step_member(@m_memory *model, const @_real *u)
{
    @_real y;
    int j;
    for (j = 0; j < @@_INPUTS; j++) {
        @_push(&model->waiting[j * @M_KEPT], @M_KEPT, @SCALED(u[j]));
    }
    y = @m_output(model->state, model->waiting);
    return @RESTORED;
}
