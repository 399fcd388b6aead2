/* The gains where the filtered output is y; Kp, Kp/Ti and Kp Td are linear between points of a schedule. */
static @_terms @_gains(@_real y)
{
@GAINS
}
