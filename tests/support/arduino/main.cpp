/* Runs the sketch beside a motor for 0.5 s; prints the counts of each period. */
#include "Arduino.h"

#include "sketch.ino"

int main() {
    setup();
    double speed = 0.0, angle = 0.0; /* RPM, counts */
    int64_t counted_here = 0;
    int phase = 0;
    uint32_t began = passed;
    for (int k = 0; k < 500; k++) {
        while (passed - began < (uint32_t)k * PERIOD + PERIOD / 2) loop();
        const double volt = SUPPLY * (duties[PIN_FORWARD] - duties[PIN_BACK]) / 255.0;
        speed += 1e-3 / 0.05 * (150.0 * volt - speed);
        angle += speed * COUNTS_PER_REV / 60.0 * 1e-3;
        for (; counted_here < (int64_t)std::floor(angle); counted_here++) {
            /* a quarter of a line on: one of both levels changes */
            const int pin = phase % 2 == 0 ? PIN_A : PIN_B;
            levels[pin] ^= 1;
            phase = (phase + 1) % 4;
            edges[pin]();
        }
        std::printf("%d %d\n", (int)counts, duties[PIN_FORWARD] - duties[PIN_BACK]);
    }
}
