
/* Other gains from the next step on, in standard form, without a bump in the command: Kp [@UNIT_U per @UNIT_Y]; Ti [s], above 0,
 * infinite for no integral action; Td [s], 0 or more. 0 where one is out of its range, and nothing is changed then.
 * Call it where a step cannot interrupt it. @_init brings back the gains and limits that are written here. */
int @_set_gains(@_pid *c, @_real Kp, @_real Ti, @_real Td);

/* Other limits of the command [@UNIT_U] from the next step on, reached no faster than slew allows. 0 unless
 * u_min < u_max, and nothing is changed then. */
int @_set_limits(@_pid *c, @_real u_min, @_real u_max);
