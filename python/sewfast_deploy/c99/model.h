#define @@_INPUTS @INPUTS
#define @@_STATES @STATES /* numbers that begin takes */
#define @@_TS @TS /* s */

@MEMORIEStypedef struct @_model {
@FIELDS} @_model;

/* At the operating point of the recording; at rest without inputs where none is known. */
void @_init(@_model *model);

/* Before the first sample: past outputs in their unit, the newest first, or states, @@_STATES numbers;
 * and inputs that were as held for as long as the model remembers, @@_INPUTS numbers. */
void @_begin(@_model *model, const @_real *state, const @_real *held);

/* Takes up this sample's @@_INPUTS inputs, in their units, and gives its output. */
@_real @_step(@_model *model, const @_real *u);
