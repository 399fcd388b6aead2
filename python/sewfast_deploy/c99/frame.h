@OPENING#ifndef @@_H
#define @@_H

#ifdef __cplusplus
extern "C" {
#endif

typedef @REAL @_real;

@BODY
#ifdef __cplusplus
}
#endif

#endif
