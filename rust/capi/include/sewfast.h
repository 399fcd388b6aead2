/* The device's side of the sewfast link, and its PID, for firmware in C99.
 *
 * The link is docs/PROTOCOL.md. What follows needs no operating system, no heap and no C library but memcpy, memmove, memset,
 * memcmp and strlen; it never blocks and takes a bounded time. Build the library for your target (any that `rustc` knows):
 *
 *     cargo rustc --package sewfast-capi --profile firmware --crate-type staticlib --target thumbv7em-none-eabihf
 *     -> target/thumbv7em-none-eabihf/firmware/libsewfast_capi.a
 *
 * The firmware brings five things: a clock, a measurement once each period, the output, and both directions of a port;
 * examples/firmware holds a main loop around them.
 *
 * Rules:
 *  - All calls come from one context (one main loop, or one interrupt priority), or are guarded against each other.
 *  - Apply what sample and poll return at once: `u` to the drive while `enabled`, else 0 V and the drive off.
 *  - After every receive and every trip call poll. Nothing is transmitted until it has told the firmware to be safe.
 *  - `now` is a clock in microseconds since boot that only goes forwards, the one that the period is made of.
 *  - A device cannot watch a processor that has stopped: start the hardware watchdog, with the output disabled at reset, and
 *    kick it after sample only. Check the stop input in hardware, too.
 */
#ifndef SEWFAST_H
#define SEWFAST_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* ---- what the device is ---------------------------------------------------------------------------------------------- */

/* Bits of `capabilities`. */
#define SEWFAST_CAN_PROFILE 1u  /* plays uploaded commands */
#define SEWFAST_CAN_PID 2u      /* runs the PID along uploaded references */
#define SEWFAST_CAN_DRIVE 4u    /* holds the command that the host sends */
#define SEWFAST_CAN_CREDIT 8u   /* computed devices only: time advances by the host's credit, sewfast_device_credit */
#define SEWFAST_CAN_CURRENT 16u /* measures the current */
#define SEWFAST_COMPUTED 32u    /* computed devices only: ARM takes them back to their initial state */
#define SEWFAST_CAN_DESIGN 64u  /* its PID has observer, reference ramp and gain schedule */
#define SEWFAST_CAN_BIQUADS 128u /* its PID has biquads */
#define SEWFAST_CAN_KINDS 256u /* runs controllers of other kinds (CONTROLLER) */
#define SEWFAST_CAN_FEEDFORWARD 512u /* its PID has feedforward */
#define SEWFAST_CAN_POSITIONS 1024u /* runs a position loop over its PID, and keeps to limits of the position; if the library was built with `--features positions` */

/* How a channel's samples are written. */
enum sewfast_encoding {
    SEWFAST_COUNTS = 0, /* the counter; i32, then differences as i16 */
    SEWFAST_STEPS = 1,  /* i16, in steps of 1/steps_per_unit */
    SEWFAST_FLOAT = 2   /* f32 */
};

/* Where a channel's value comes from. */
enum sewfast_source {
    SEWFAST_FROM_COUNTS = 0,
    SEWFAST_FROM_COMMAND = 1,   /* as applied */
    SEWFAST_FROM_CURRENT = 2,
    SEWFAST_FROM_REFERENCE = 3, /* NaN where the PID does not run */
    SEWFAST_FROM_FEEDBACK = 4,  /* after its filter; NaN where the PID does not run */
    SEWFAST_FROM_FURTHER = 5    /* further[...] of the measurement */
};

typedef struct sewfast_channel {
    uint8_t encoding; /* enum sewfast_encoding */
    uint8_t source;   /* enum sewfast_source */
    uint8_t further;  /* index of SEWFAST_FROM_FURTHER */
    uint32_t steps_per_unit;
    const char *name; /* UTF-8, at most 15 bytes */
    const char *unit; /* UTF-8, at most 7 bytes */
} sewfast_channel;

typedef struct sewfast_limits {
    float volt;         /* V, above 0; times the steps per unit of channel 1 at most 32767 */
    float speed;        /* RPM, or INFINITY */
    float acceleration; /* RPM/s, or INFINITY */
    float current;      /* A; INFINITY where it is not measured */
} sewfast_limits;

/* Texts must stay where they are for as long as the device is used; the rest is copied. */
typedef struct sewfast_identity {
    uint32_t boot_id;     /* its low 16 bits differ from those of the boot before: count in non-volatile memory, or entropy */
    uint32_t entropy;     /* of a random generator, or the noise of a converter; any where there is none: see ARM in PROTOCOL.md */
    const char *name;     /* UTF-8, at most 24 bytes */
    const char *firmware; /* UTF-8, at most 16 bytes */
    uint32_t period;      /* us, 10 to 1,000,000 */
    float counts_per_rev; /* 1 to 1e9 */
    uint32_t capabilities;
    sewfast_limits ceilings;         /* what no host can go beyond */
    const sewfast_channel *channels; /* [0]: counts of the counter; [1]: steps of the command */
    size_t channel_count;            /* 2 to 16 */
    int32_t travel_low, travel_high; /* where the counter may be during a run; both 0: anywhere */
} sewfast_identity;

/* ---- what goes in and out -------------------------------------------------------------------------------------------- */

typedef struct sewfast_measurement {
    int32_t counts;       /* it may wrap */
    float current;        /* A; NAN where none is measured */
    const float *further; /* may be NULL */
    size_t further_count;
} sewfast_measurement;

typedef struct sewfast_output {
    float u; /* V; 0 where not enabled */
    bool enabled;
} sewfast_output;

enum sewfast_state {
    SEWFAST_BOOT = 0,
    SEWFAST_IDLE = 1,
    SEWFAST_ARMED = 2,
    SEWFAST_RUNNING = 3,
    SEWFAST_TRIPPED = 4
};

enum sewfast_reason {
    SEWFAST_NO_REASON = 0,
    SEWFAST_WATCHDOG = 1,
    SEWFAST_SPEED = 2,
    SEWFAST_ACCELERATION = 3,
    SEWFAST_CURRENT = 4,
    SEWFAST_UNDERRUN = 5,
    SEWFAST_BAD_COMMAND = 6,
    SEWFAST_HOST_CHANGED = 7,
    SEWFAST_MEASUREMENT = 8,
    SEWFAST_NO_MOTION = 9,
    SEWFAST_STOP_INPUT = 10,
    SEWFAST_LATE = 11,
    SEWFAST_SWINGING = 12,
    SEWFAST_TRAVEL = 13
};

/* ---- the device ------------------------------------------------------------------------------------------------------ */

typedef struct sewfast_device sewfast_device;

/* Values of a profile that a device holds: 2 s at 1 kHz. Runs may be longer; the host then uploads while they play. */
#define SEWFAST_CAPACITY 2048

/* Enough bytes on any target; sewfast_device_init refuses less than sewfast_device_size(). As static storage:
 *     static union { uint64_t align; unsigned char bytes[SEWFAST_DEVICE_SIZE]; } storage; */
#define SEWFAST_DEVICE_SIZE 15360

/* Why there is no device. */
enum sewfast_refusal {
    SEWFAST_DONE = 0,
    SEWFAST_REFUSED_STORAGE = 1, /* NULL, too small, or not aligned */
    SEWFAST_REFUSED_TEXT = 2,    /* NULL or not UTF-8 */
    SEWFAST_REFUSED_NAME = 3,
    SEWFAST_REFUSED_FIRMWARE = 4,
    SEWFAST_REFUSED_PERIOD = 5,
    SEWFAST_REFUSED_COUNTS_PER_REV = 6,
    SEWFAST_REFUSED_CEILINGS = 7,
    SEWFAST_REFUSED_CHANNELS = 8,
    SEWFAST_REFUSED_TRAVEL = 9
};

size_t sewfast_device_size(void);
size_t sewfast_device_alignment(void);

/* A device at boot, in `size` bytes at `storage`, which must not move. NULL where something is refused; `refusal`, unless it is
 * NULL, says what. Ten good samples later it is idle. */
sewfast_device *sewfast_device_init(void *storage, size_t size, const sewfast_identity *identity, int32_t *refusal);

/* Bytes have come from the port. Call poll afterwards. */
void sewfast_device_receive(sewfast_device *device, uint64_t now, const uint8_t *bytes, size_t count);

/* Once each period, as soon as it was measured: the command until the next one. `now` is when the sample was taken. A run
 * ends where a sample comes a period late, or is left out. */
sewfast_output sewfast_device_sample(sewfast_device *device, uint64_t now, const sewfast_measurement *measurement);

/* As often as the main loop goes round, and after receive and trip: the command as it is now. */
sewfast_output sewfast_device_poll(sewfast_device *device, uint64_t now);

/* At most `size` bytes to be sent are moved to `out`; how many. Take only what the port has room for. */
size_t sewfast_device_transmit(sewfast_device *device, uint8_t *out, size_t size);

/* The firmware's own reasons to stop: its stop input, a fault of the drive. Only the host's CLEAR, ARM, START lead on. Call it each
 * time round for as long as the reason stands, not at its edge only: CLEAR does not know of a stop input that is still pressed. */
void sewfast_device_trip(sewfast_device *device, uint64_t now, int32_t reason);

/* SEWFAST_CAN_CREDIT only: true where the host lets the time of a computed device advance, until `*until` us, the time of the last
 * sample that may be taken; false where its time runs by itself. */
bool sewfast_device_credit(sewfast_device *device, uint64_t *until);

/* SEWFAST_COMPUTED only: how often ARM was executed since boot. Where this has changed, the machine returns to its initial state
 * before the next sample. */
uint32_t sewfast_device_armed_count(sewfast_device *device);

/* The transport knows that the host has gone (a closed socket, a USB port without terminal). */
void sewfast_device_disconnect(sewfast_device *device);

int32_t sewfast_device_state(sewfast_device *device);  /* enum sewfast_state */
int32_t sewfast_device_reason(sewfast_device *device); /* enum sewfast_reason, of the last trip */

/* ---- the PID alone --------------------------------------------------------------------------------------------------- */

typedef struct sewfast_pid sewfast_pid;

/* The most points of a gain schedule. */
#define SEWFAST_PID_POINTS 8

/* Gains at one size of the filtered output. */
typedef struct sewfast_pid_point {
    float speed; /* y, 0 or more, growing from point to point */
    float kp;    /* u/y */
    float ti;    /* s; INFINITY: no integral action */
    float td;    /* s */
} sewfast_pid_point;

/* The most biquads. */
#define SEWFAST_PID_BIQUADS 4

/* A second-order section H = 1 + (1 - q)(c0 + c1 q)/(1 + a1 q + a2 q^2), q = 1/z, on reference and feedback; make it with
 * sewfast_pid_notch and its like. */
typedef struct sewfast_pid_biquad {
    float c0, c1, a1, a2;
} sewfast_pid_biquad;

/* The most levels and taps of a feedforward, and its longest preview in samples. */
#define SEWFAST_PID_LEVELS 8
#define SEWFAST_PID_TAPS 16
#define SEWFAST_PID_AHEAD 30

/* A command u that holds the output y. */
typedef struct sewfast_pid_level {
    float y, u;
} sewfast_pid_level;

/* Two-degree-of-freedom PID in standard form with its feedback filter; INFINITY switches off what it limits. */
typedef struct sewfast_pid_settings {
    float kp;          /*  1: u/y */
    float ti;          /*  2: s; INFINITY: no integral action */
    float td;          /*  3: s */
    float alpha;       /*  4: share of the reference taken out of the proportional term */
    float beta;        /*  5: share of the reference taken out of the derivative term */
    float n;           /*  6: the derivative's filter is td/n; INFINITY: none */
    float tt;          /*  7: s, anti-windup; 0: the integral stops at the limit */
    float u_min;       /*  8 */
    float u_max;       /*  9 */
    float slew;        /* 10: u/s */
    float ts;          /* 11: s, sample time */
    float filter_time; /* 12: s, lag of the feedback; 0: none */
    uint8_t filter_samples; /* 13: moving average of the feedback, 1 to 64; 1: none */
    float observer_time;    /* 14: s, alpha-beta observer of the feedback; 0: none */
    float r_rate;           /* 15: y/s, ramp of the reference; INFINITY: none */
    uint8_t schedule_count; /* 16: points that are used; 0: the constant gains above */
    sewfast_pid_point schedule[SEWFAST_PID_POINTS];
    uint8_t biquad_count;   /* 17: biquads that are used; 0: none */
    sewfast_pid_biquad biquads[SEWFAST_PID_BIQUADS];
    uint8_t level_count;    /* 18: levels of the feedforward; with no tap either there is none */
    uint8_t tap_count;      /* 18: taps that are used */
    uint8_t preview;        /* 18: samples by which the reference given to a step is early */
    float late;             /* 18: 0 to 1 sample by which the measurement is late before its filter; .5 for a speed from counts */
    sewfast_pid_level levels[SEWFAST_PID_LEVELS]; /* 18: y growing; between them the command is linear */
    float taps[SEWFAST_PID_TAPS]; /* 18: u/y, command per change of the reference, the newest change's first */
} sewfast_pid_settings;

/* Enough bytes on any target. */
#define SEWFAST_PID_SIZE 2048

size_t sewfast_pid_size(void);

/* A controller at rest in `size` bytes at `storage`, aligned for float and size_t. NULL where something is refused; `refusal`, unless it is
 * NULL, is then the number of the setting, or -1 for the storage. */
sewfast_pid *sewfast_pid_init(void *storage, size_t size, const sewfast_pid_settings *settings, int32_t *refusal);

/* Biquads at a sample time of `ts` s; false where a frequency (Hz) is not between 0 and half the sample rate or another number is
 * outside its range, `biquad` is then left as it was. */

/* Gain `depth`, 0 to 1, at `frequency`; `width` times as wide as it is high. */
bool sewfast_pid_notch(sewfast_pid_biquad *biquad, float frequency, float depth, float width, float ts);
bool sewfast_pid_low_pass(sewfast_pid_biquad *biquad, float frequency, float damping, float ts);
/* (1 + s/zero)/(1 + s/pole), both in Hz. */
bool sewfast_pid_lead_lag(sewfast_pid_biquad *biquad, float zero, float pole, float ts);
/* A pair of zeros and one of poles, each with its frequency (Hz) and its damping. */
bool sewfast_pid_resonance(sewfast_pid_biquad *biquad, float zero_frequency, float zero_damping, float pole_frequency,
                           float pole_damping, float ts);

/* From reference and measured output to the command. A measurement that is not finite leaves the command as it was. */
float sewfast_pid_step(sewfast_pid *pid, float r, float y);

/* The same with a command that is added before the limits. */
float sewfast_pid_step_with(sewfast_pid *pid, float r, float y, float feedforward);

/* Other settings from the next sample on, without a bump in the command; the sample time must stay. 0, or the number of the setting
 * that is refused, or -1 for NULL; nothing is changed then. */
int32_t sewfast_pid_change(sewfast_pid *pid, const sewfast_pid_settings *settings);

/* From the next sample on the command is `u`, within the limits; false where `u` is not finite. */
bool sewfast_pid_set_manual(sewfast_pid *pid, float u);

/* The controller's command again, beginning where the operator's was. */
void sewfast_pid_set_automatic(sewfast_pid *pid);

/* Back to rest, in automatic. */
void sewfast_pid_reset(sewfast_pid *pid);

#ifdef __cplusplus
}
#endif

#endif
