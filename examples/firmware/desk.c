/* A board that is a computer: a pseudo-terminal instead of a UART, a computed motor instead of a drive. It lets the firmware be
 * tried with `sewfast doctor PORT`, `record` and `run` before there is any hardware (POSIX only; built by `make c-test`).
 *
 * The first line that it prints is `port NAME`. A computer does not keep a millisecond: where it was late, the periods are made
 * up for one after the other, each with the time at which it was due, before anything else is read. */
#define _XOPEN_SOURCE 600

#include "board.h"

#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { PERIOD = 1000, FINE = 20 };

static const double COUNTS_PER_REV = 1572.0;
static const double GAIN = 490.0; /* RPM/V */
static const double LAG = 0.15;   /* s */

static int port = -1;
static uint64_t sampled, now;
static double speed, turns; /* RPM, revolutions */
static double applied;      /* V */

static uint64_t real_time(void) {
    static struct timespec start;
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    if (start.tv_sec == 0) start = t;
    return (uint64_t)((t.tv_sec - start.tv_sec) * 1000000LL + (t.tv_nsec - start.tv_nsec) / 1000);
}

static bool is_behind(void) {
    return real_time() >= sampled + PERIOD;
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
    if (!is_behind()) {
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
    const ssize_t count = is_behind() ? 0 : read(port, bytes, size);
    return count > 0 ? (size_t)count : 0;
}

size_t board_write(const uint8_t *bytes, size_t count) {
    const ssize_t taken = write(port, bytes, count);
    return taken > 0 ? (size_t)taken : 0;
}

/* Without memory that outlives the program, entropy: the same low 16 bits as at the boot before come once in 65536 boots. A drive has a
 * counter in non-volatile memory instead, which never gives them. */
static uint32_t boot_id(void) {
    uint32_t id = (uint32_t)time(NULL) * 2654435761u ^ (uint32_t)getpid();
    FILE *source = fopen("/dev/urandom", "rb");
    if (source != NULL) {
        uint32_t drawn;
        if (fread(&drawn, sizeof drawn, 1, source) == 1) id = drawn;
        fclose(source);
    }
    return id;
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
    if (!open_port() || !firmware_init(boot_id())) {
        fprintf(stderr, "desk: no pseudo-terminal, or the identity is refused\n");
        return 1;
    }
    printf("port %s\n", ptsname(port));
    fflush(stdout);
    real_time();
    for (;;) firmware_step();
}
