typedef struct @m_memory {
    @_real state[@SIZE]; /* past outputs, the newest first, or states; scaled */
    @_real waiting[@ROOM]; /* past inputs, the newest first */
} @m_memory;

