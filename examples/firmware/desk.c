/* A board on a computer: a pseudo-terminal instead of a UART, a simulated motor instead of a drive. With it, the firmware can be
 * tested with `sewfast doctor PORT`, `record` and `run` before there is any hardware (POSIX only; built by `make c-test`).
 *
 * The first line that it prints is `port NAME`. A computer cannot keep a period of 1 ms: if it was late, the missed periods are
 * computed one after the other, each with its due time. Bytes received meanwhile are spread over them, because their times of
 * arrival are unknown: read after the periods, a host's heartbeats would all be late, and before them, all early. */
#define _XOPEN_SOURCE 600

#include "board.h"

#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { PERIOD = 1000, FINE = 20 };

static const float COUNTS_PER_REV = 1572.0f;
static const double GAIN = 490.0; /* RPM/V */
static const double LAG = 0.15;   /* s */

static int port = -1;
static uint64_t sampled, now;
static double speed, turns; /* RPM, revolutions */
static double applied;      /* V */
static uint8_t held[4096];  /* received, not yet handed over */
static size_t held_count;

static uint64_t real_time(void) {
    static struct timespec start;
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    if (start.tv_sec == 0) start = t;
    return (uint64_t)((t.tv_sec - start.tv_sec) * 1000000LL + (t.tv_nsec - start.tv_nsec) / 1000);
}

/* Periods that are due and not yet sampled. */
static uint64_t behind(void) {
    return (real_time() - sampled) / PERIOD;
}

uint64_t board_time(void) {
    const uint64_t real = real_time(), end = sampled + PERIOD - 1;
    const uint64_t time = real < end ? real : end;
    now = time > now ? time : now;
    return now;
}

static void turn_the_motor(void) {
    const double step = 1e-6 * PERIOD / FINE;
    for (int k = 0; k < FINE; k++) {
        speed += step * (GAIN * applied - speed) / LAG;
        turns += step * speed / 60.0;
    }
}

bool board_measure(sewfast_measurement *measurement, uint64_t *when) {
    if (behind() == 0) {
        const struct timespec nap = {0, 100000};
        nanosleep(&nap, NULL);
        return false;
    }
    turn_the_motor();
    sampled += PERIOD;
    now = sampled;
    const sewfast_measurement found = {(int32_t)floor(turns * COUNTS_PER_REV), NAN, NULL, 0};
    *measurement = found;
    *when = now;
    return true;
}

void board_apply(sewfast_output output) {
    applied = output.enabled ? output.u : 0.0;
}

size_t board_read(uint8_t *bytes, size_t size) {
    const ssize_t come = read(port, held + held_count, sizeof held - held_count);
    if (come > 0) held_count += (size_t)come;
    const size_t turns_left = (size_t)behind() + 1;
    size_t count = (held_count + turns_left - 1) / turns_left;
    if (count > size) count = size;
    memcpy(bytes, held, count);
    held_count -= count;
    memmove(held, held + count, held_count);
    return count;
}

size_t board_write(const uint8_t *bytes, size_t count) {
    const ssize_t taken = write(port, bytes, count);
    return taken > 0 ? (size_t)taken : 0;
}

/* Entropy, because no memory outlives the program: one boot in 65536 has the same low 16 bits as the previous one. A drive uses a
 * counter in non-volatile memory instead, which never repeats them. */
static uint32_t drawn(void) {
    uint32_t id = (uint32_t)time(NULL) * 2654435761u ^ (uint32_t)getpid();
    FILE *source = fopen("/dev/urandom", "rb");
    if (source != NULL) {
        uint32_t bits;
        if (fread(&bits, sizeof bits, 1, source) == 1) id = bits;
        fclose(source);
    }
    return id;
}

void board_identity(sewfast_identity *identity) {
    static const sewfast_channel channels[] = {
        {SEWFAST_COUNTS, SEWFAST_FROM_COUNTS, 0, 1, "counts", "1"},
        {SEWFAST_STEPS, SEWFAST_FROM_COMMAND, 0, 1000, "u", "V"},
        {SEWFAST_FLOAT, SEWFAST_FROM_FEEDBACK, 0, 1, "feedback", "RPM"},
    };
    identity->boot_id = drawn();
    identity->entropy = drawn();
    identity->name = "example drive";
    identity->firmware = "1.0";
    identity->period = PERIOD;
    identity->counts_per_rev = COUNTS_PER_REV;
    identity->capabilities =
        SEWFAST_CAN_PROFILE | SEWFAST_CAN_PID | SEWFAST_CAN_DRIVE | SEWFAST_CAN_DESIGN | SEWFAST_CAN_BIQUADS |
        SEWFAST_CAN_FEEDFORWARD |
        SEWFAST_CAN_POSITIONS;
    identity->ceilings = (sewfast_limits){20.0f, 4000.0f, 60000.0f, INFINITY}; /* what the machine can withstand */
    identity->channels = channels;
    identity->channel_count = sizeof channels / sizeof channels[0];
}

static bool open_port(void) {
    struct termios raw;
    port = posix_openpt(O_RDWR | O_NOCTTY);
    if (port < 0 || grantpt(port) != 0 || unlockpt(port) != 0) return false;
    const int other = open(ptsname(port), O_RDWR | O_NOCTTY);
    if (other < 0 || tcgetattr(other, &raw) != 0) return false;
    raw.c_iflag = raw.c_oflag = raw.c_lflag = 0;
    raw.c_cflag |= CS8 | CREAD | CLOCAL;
    return tcsetattr(other, TCSANOW, &raw) == 0 && close(other) == 0 && fcntl(port, F_SETFL, O_NONBLOCK) == 0;
}

int main(void) {
    if (!open_port() || !firmware_init()) {
        fprintf(stderr, "desk: no pseudo-terminal, or the identity is refused\n");
        return 1;
    }
    printf("port %s\n", ptsname(port));
    fflush(stdout);
    real_time();
    for (;;) firmware_step();
}
