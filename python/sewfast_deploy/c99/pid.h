#define @@_TS @TS /* s */
#define @@_SAMPLES @SAMPLES /* of the moving average */

@BIQUADS_TYPE@AHEAD_TYPE@TERMS_TYPEtypedef struct @_pid {
@FILTER_MEMORY    @_real ramped; /* the reference after its ramp */
    @_real integral, derivative;
    @_real r, e; /* of the last sample */
    @_real u, operator_u;
    @_real filtered; /* the measurement after its filter */
@MEMBERS@FILTER_NEXT    unsigned char @FILTER_FLAGSramping, manual, started@FLAGS;
} @_pid;

/* At rest, in automatic. */
void @_init(@_pid *c);

/* From reference and measurement [@UNIT_Y] to the command [@UNIT_U]. A measurement that is not finite leaves the
 * command as it was. Whatever comes, the command is finite, within its limits and no further from the last
 * one than slew allows.@EARLY */
@_real @_step(@_pid *c, @_real r, @_real y);

/* The same with a command that is added before the limits. */
@_real @_step_with(@_pid *c, @_real r, @_real y, @_real feedforward);

/* From the next sample on the command is u, within the limits; 0 where u is not finite. */
int @_set_manual(@_pid *c, @_real u);

/* The controller's command again, beginning where the operator's was. */
void @_set_automatic(@_pid *c);
@CHANGES