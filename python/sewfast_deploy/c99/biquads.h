#define @@_BIQUADS @SECTIONS

/* What a section of second order remembers. */
typedef struct @_biquad {
    @_real x, s1, s2;
} @_biquad;

