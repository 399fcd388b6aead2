/* An emulated board, Cortex-M4 or Cortex-M7: QEMU's mps2-an386 or mps2-an500, with UART0 as port and a simulated motor
 * with dry friction as drive (built by `make firmware`, started by `sewfast pil`).
 *
 * It runs on credit unless real time is requested: once a host has opened a session, its time advances only as far as the host
 * grants, so that the load of the computer changes no recording. A serial line does not show that the host has gone: time then
 * stops until the next host. */
#include "board.h"

#include <math.h>
#include <string.h>

enum { PERIOD = 1000, TICKS_PER_US = 25, RING = 1024, LATE = 250 };

static const float COUNTS_PER_REV = 1572.0f;
static const float GAIN = 490.0f;    /* RPM/V */
static const float LAG = 0.15f;      /* s */
static const float FRICTION = 0.25f; /* V */

typedef struct {
    volatile uint32_t data, state, control, interrupt, divider;
} uart_registers;
typedef struct {
    volatile uint32_t control, value, reload, interrupt;
} timer_registers;
static uart_registers *const UART = (uart_registers *)0x40004000u;
static timer_registers *const TIMER = (timer_registers *)0x40000000u;
static volatile uint32_t *const ENABLE_INTERRUPTS = (volatile uint32_t *)0xE000E100u;
static volatile uint32_t *const COPROCESSORS = (volatile uint32_t *)0xE000ED88u;

/* Memory that the computer reads and writes as a file; python/sewfast_deploy/emulated.py has the same layout. The stack is
 * next to it, so that its depth can be read from there too. All zeros if no file is given. */
typedef struct {
    uint32_t boot_id, entropy;
    uint32_t real_time;   /* from the computer: 1 offers no credit */
    uint32_t samples;     /* control steps so far, and their ticks from measurement to output */
    uint32_t least, most;
    uint64_t total;
    uint64_t heard;       /* us: when bytes last arrived */
    uint64_t safe;        /* us: when the output was last switched off */
    uint32_t enabled;
    /* from the computer: what is wrong with the motor, from a time after its output was switched on (0: always) */
    uint32_t fault;       /* its number; 0: nothing is wrong */
    uint32_t after;       /* us */
    float command, encoder, lag;      /* factors */
    float load, stuck, dead, brake;   /* V; stuck: NAN if it obeys, infinite if it stays as it is */
    float jump;           /* counts, once */
    float fastest;        /* RPM, to the computer */
} shared_memory;
__attribute__((section(".shared"))) static volatile shared_memory shared;

static volatile uint8_t ring[RING];
static volatile uint32_t written, taken;
static uint64_t sampled;  /* us */
static uint32_t last;     /* the timer, which counts down */
static uint32_t elapsed;  /* ticks since the last sample, while time runs by itself */
static float applied;     /* V */
static float speed;       /* RPM */
static float fraction;    /* counts */
static int32_t counts;
static uint32_t measured; /* ticks: when the last measurement without an output was handed over */
static bool pending;
static uint64_t switched_on; /* us: when the output was last switched on */
static uint32_t fault;       /* the number of what is wrong with the motor */
static bool wrong;           /* it has begun */
static float stays;          /* V: its command then */
static bool idle;            /* nothing was measured, read or written since the last look for bytes */

/* A byte for which the ring has no room stays in the UART, which then accepts no other. */
static void pump(void) {
    while ((UART->state & 2u) != 0 && written - taken < RING) {
        ring[written % RING] = (uint8_t)UART->data;
        written++;
    }
}

/* Acknowledge before emptying: otherwise a byte that arrives between the two would never be read. */
void UART_Handler(void) {
    UART->interrupt = 2;
    pump();
}

static bool on_credit(uint64_t *until) {
    sewfast_device *device = firmware_device();
    return device != NULL && sewfast_device_credit(device, until);
}

static void let_time_pass(void) {
    const uint32_t value = TIMER->value;
    elapsed += last - value;
    last = value;
}

uint64_t board_time(void) {
    uint64_t until;
    if (on_credit(&until)) return sampled;
    let_time_pass();
    const uint32_t since = elapsed / TICKS_PER_US;
    return sampled + (since < PERIOD ? since : PERIOD - 1);
}

static void turn_the_motor(void) {
    const bool due = shared.after == 0 || (shared.enabled && sampled - switched_on >= shared.after);
    if (fault != shared.fault) {
        fault = shared.fault;
        wrong = false;
    }
    if (!wrong && fault != 0 && due) {
        counts += (int32_t)shared.jump;
        stays = applied;
        wrong = true;
    }
    float u = applied, friction = FRICTION, lag = LAG, encoder = 1.0f;
    if (wrong) {
        u = shared.command * copysignf(fmaxf(fabsf(u) - shared.dead, 0.0f), u);
        if (!isnan(shared.stuck)) u = isinf(shared.stuck) ? stays : shared.stuck;
        u += shared.load;
        friction += shared.brake;
        lag *= shared.lag;
        encoder = shared.encoder;
    }
    const float share = 1e-6f * PERIOD / lag;
    const bool held = fabsf(u) <= friction;
    if (speed != 0.0f || !held) {
        const float against = copysignf(friction, speed != 0.0f ? speed : u);
        const float next = speed + share * (GAIN * (u - against) - speed);
        speed = held && next * speed <= 0.0f ? 0.0f : next;
    }
    if (fabsf(speed) > shared.fastest) shared.fastest = fabsf(speed);
    fraction += encoder * speed * COUNTS_PER_REV * (1e-6f * PERIOD / 60.0f);
    const int32_t whole = (int32_t)floorf(fraction);
    counts += whole;
    fraction -= (float)whole;
}

bool board_measure(sewfast_measurement *measurement, uint64_t *when) {
    uint64_t until;
    let_time_pass();
    if (on_credit(&until)) {
        elapsed = 0;
        if (sampled + PERIOD > until) return false;
    } else {
        if (elapsed < PERIOD * TICKS_PER_US) return false;
        elapsed -= PERIOD * TICKS_PER_US;
    }
    turn_the_motor();
    idle = false;
    sampled += PERIOD;
    const sewfast_measurement found = {counts, NAN, NULL, 0};
    *measurement = found;
    *when = sampled;
    pending = true;
    measured = TIMER->value;
    return true;
}

static void count_the_step(void) {
    const uint32_t ticks = measured - TIMER->value;
    pending = false;
    if (shared.samples == 0 || ticks < shared.least) shared.least = ticks;
    if (ticks > shared.most) shared.most = ticks;
    shared.total += ticks;
    shared.samples++;
}

void board_apply(sewfast_output output) {
    /* an output holds from its sample on, even if the sample is computed late */
    if (shared.enabled && !output.enabled) shared.safe = pending ? sampled : board_time();
    if (pending) count_the_step();
    if (!shared.enabled && output.enabled) switched_on = sampled;
    shared.enabled = output.enabled;
    applied = output.enabled ? output.u : 0.0f;
}

/* Periods behind real time, after the computer has paused the emulator. They are computed one after the other, and
 * meanwhile the board's time is that of the period, earlier than the messages that request it. So messages wait for the last
 * period; not for ever, because a computer that is too slow never reaches it. */
static bool catching_up(void) {
    uint64_t until;
    if (on_credit(&until)) return false;
    let_time_pass();
    const uint32_t periods = elapsed / (PERIOD * TICKS_PER_US);
    return periods > 0 && periods < LATE;
}

/* On credit nothing can happen before the host says something. To sleep until then leaves the emulator to its other thread,
 * which brings the bytes: on a busy computer a loop that polls its registers keeps it waiting for seconds. */
static void sleep_until_bytes_come(void) {
    uint64_t until;
    if (!idle || !on_credit(&until)) return;
    __asm__ volatile("cpsid i" ::: "memory");
    if (taken == written) __asm__ volatile("wfi"); /* a byte that comes before it ends it at once */
    __asm__ volatile("cpsie i" ::: "memory");
}

size_t board_read(uint8_t *bytes, size_t size) {
    size_t count = 0;
    sleep_until_bytes_come();
    idle = true;
    const uint32_t come = written; /* before the clock is read: the emulator can be paused between the two */
    if (catching_up()) return 0;
    while (count < size && taken != come) {
        bytes[count++] = ring[taken % RING];
        taken++;
    }
    if (count > 0) {
        shared.heard = board_time();
        idle = false;
    }
    __asm__ volatile("cpsid i" ::: "memory");
    pump(); /* bytes that had no room */
    __asm__ volatile("cpsie i" ::: "memory");
    return count;
}

size_t board_write(const uint8_t *bytes, size_t count) {
    size_t sent = 0;
    idle = false;
    while (sent < count && (UART->state & 1u) == 0) UART->data = bytes[sent++];
    return sent;
}

void board_identity(sewfast_identity *identity) {
    static const sewfast_channel channels[] = {
        {SEWFAST_COUNTS, SEWFAST_FROM_COUNTS, 0, 1, "counts", "1"},
        {SEWFAST_STEPS, SEWFAST_FROM_COMMAND, 0, 1000, "u", "V"},
        {SEWFAST_FLOAT, SEWFAST_FROM_FEEDBACK, 0, 1, "feedback", "RPM"},
    };
    identity->boot_id = shared.boot_id;
    identity->entropy = shared.entropy;
    identity->name = "emulated drive";
    identity->firmware = "1.0";
    identity->period = PERIOD;
    identity->counts_per_rev = COUNTS_PER_REV;
    identity->capabilities =
        SEWFAST_CAN_PROFILE | SEWFAST_CAN_PID | SEWFAST_CAN_DRIVE | SEWFAST_CAN_DESIGN | SEWFAST_CAN_BIQUADS |
        SEWFAST_CAN_FEEDFORWARD |
        SEWFAST_CAN_POSITIONS;
    if (!shared.real_time) identity->capabilities |= SEWFAST_CAN_CREDIT;
    identity->ceilings = (sewfast_limits){20.0f, 8000.0f, 90000.0f, INFINITY};
    identity->channels = channels;
    identity->channel_count = sizeof channels / sizeof channels[0];
}

extern uint32_t __stack, __data, __data_end, __data_load, __bss_start__, __bss_end__;

void Reset_Handler(void) {
    *COPROCESSORS |= 0xFu << 20; /* the floating-point unit, before any float */
    __asm__ volatile("dsb; isb");
    memcpy(&__data, &__data_load, (size_t)((char *)&__data_end - (char *)&__data));
    memset(&__bss_start__, 0, (size_t)((char *)&__bss_end__ - (char *)&__bss_start__));
    TIMER->reload = TIMER->value = last = 0xFFFFFFFFu;
    TIMER->control = 1;
    UART->divider = 16;
    UART->control = 1u | 2u | 8u; /* send, receive, interrupt when a byte arrives */
    *ENABLE_INTERRUPTS = 1;
    if (firmware_init()) {
        for (;;) firmware_step();
    }
    for (;;) __asm__ volatile("wfi");
}

static void Fault_Handler(void) {
    for (;;) __asm__ volatile("wfi");
}

__attribute__((section(".vectors"), used)) static const void *const vectors[17] = {
    &__stack,      (void *)Reset_Handler, (void *)Fault_Handler, (void *)Fault_Handler, (void *)Fault_Handler,
    (void *)Fault_Handler, (void *)Fault_Handler, [16] = (void *)UART_Handler,
};
