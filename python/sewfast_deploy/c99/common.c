/* The newest value comes first, the oldest is lost. */
static void @_push(@_real *window, int length, @_real newest)
{
    int i;
    for (i = length - 1; i > 0; i--) {
        window[i] = window[i - 1];
    }
    window[0] = newest;
}
