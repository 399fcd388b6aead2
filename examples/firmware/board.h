/* The interface of a board: six functions that a firmware author writes. */
#ifndef BOARD_H
#define BOARD_H

#include "sewfast.h"

/* Describes the drive: boot id, entropy, name, period, counts per turn, capabilities, ceilings, channels. Called once, before
 * anything else; texts and channels must stay valid. */
void board_identity(sewfast_identity *identity);

/* Microseconds since boot, from a timer that never goes back; 64 bits, read without tearing. */
uint64_t board_time(void);

/* True once each control period, then with the measured values and their time: a flag that the timer's interrupt sets after it has
 * latched counter and current. */
bool board_measure(sewfast_measurement *measurement, uint64_t *when);

/* Drives the motor with `u` volt, or switches the drive off. Must be safe at reset, before anything calls it. */
void board_apply(sewfast_output output);

/* Reads at most `size` received bytes and returns their number. Does not wait. */
size_t board_read(uint8_t *bytes, size_t size);

/* Sends as many of `count` bytes as there is room for and returns their number. Does not wait. */
size_t board_write(const uint8_t *bytes, size_t count);

/* The loop around them. */
bool firmware_init(void);
void firmware_step(void);

/* For functions that only some boards need: credit, a stop input. */
sewfast_device *firmware_device(void);

#endif
