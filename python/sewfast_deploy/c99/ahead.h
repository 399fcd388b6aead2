#define @@_PREVIEW @PREVIEW /* samples by which the reference arrives early */
#define @@_KEPT @KEPT /* references */

/* A filter of the feedback. */
typedef struct @_filtering {
    @_real samples[@@_SAMPLES];
    @_real lag, speed, innovation;
    int next;
    unsigned char averaging, lagging, observing;
} @_filtering;

