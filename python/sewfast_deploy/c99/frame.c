@OPENING#include "@NAME.h"

#ifdef __FAST_MATH__
#error "fast-math would change the results; compile without it"
#endif
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#endif

@BODY
