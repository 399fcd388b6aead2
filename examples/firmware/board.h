/* What a board brings: the six functions that a firmware author writes. */
#ifndef BOARD_H
#define BOARD_H

#include "sewfast.h"

/* Says what the drive is: boot id, entropy, name, period, counts per turn, capabilities, ceilings, channels. Called once, before
 * anything else; texts and channels stay where they are. */
void board_identity(sewfast_identity *identity);

/* Microseconds since boot, from a timer that only goes forwards; 64 bits, read without tearing. */
uint64_t board_time(void);

/* True once each control period, then with what was measured and when: a flag that the timer's interrupt sets after it has
 * latched counter and current. */
bool board_measure(sewfast_measurement *measurement, uint64_t *when);

/* Drives the motor with `u` volt, or switches the drive off. Must be safe at reset, before anything calls it. */
void board_apply(sewfast_output output);

/* At most `size` bytes that have come; how many. Does not wait. */
size_t board_read(uint8_t *bytes, size_t size);

/* Sends as many of `count` bytes as there is room for; how many. Does not wait. */
size_t board_write(const uint8_t *bytes, size_t count);

/* The loop around them. */
bool firmware_init(void);
void firmware_step(void);

/* For what only some boards need: credit, a stop input. */
sewfast_device *firmware_device(void);

#endif
