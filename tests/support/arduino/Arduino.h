/* What the sketch needs of an Arduino, on a computer: time passes with each look at it, the encoder is a motor's. */
#include <cmath>
#include <cstdint>
#include <cstdio>

enum { INPUT_PULLUP = 2, CHANGE = 1 };
static uint32_t passed = 0xFFFFF000u;  /* us: wraps after 4 ms */
static void (*edges[8])();
static int levels[8], duties[8];

inline uint32_t micros() { return passed += 50; }
inline void pinMode(int, int) {}
inline int digitalPinToInterrupt(int pin) { return pin; }
inline void attachInterrupt(int pin, void (*routine)(), int) { edges[pin] = routine; }
inline void noInterrupts() {}
inline void interrupts() {}
inline int digitalRead(int pin) { return levels[pin]; }
inline void analogWrite(int pin, int duty) { duties[pin] = duty; }
