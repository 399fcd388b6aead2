/* The firmware of a drive around the sewfast device: everything except the board.
 *
 *     int main(void) {
 *         board_init();
 *         if (!firmware_init()) halt_with_the_drive_off();
 *         for (;;) firmware_step();
 *     }
 */
#include "board.h"

static union {
    uint64_t align;
    unsigned char bytes[SEWFAST_DEVICE_SIZE];
} storage;

static sewfast_device *device;

/* False if the board's identity is refused. */
bool firmware_init(void) {
    sewfast_identity identity = {0};
    board_identity(&identity);
    device = sewfast_device_init(&storage, sizeof storage, &identity, NULL);
    return device != NULL;
}

/* NULL before firmware_init. */
sewfast_device *firmware_device(void) {
    return device;
}

static void communicate(void) {
    static uint8_t out[64];
    static size_t waiting, sent;
    uint8_t in[64];
    size_t count = board_read(in, sizeof in);
    if (count > 0) {
        uint64_t now = board_time();
        sewfast_device_receive(device, now, in, count);
        board_apply(sewfast_device_poll(device, now));
    }
    if (sent == waiting) {
        sent = 0;
        waiting = sewfast_device_transmit(device, out, sizeof out);
    }
    if (sent < waiting) {
        sent += board_write(out + sent, waiting - sent);
    }
}

/* One pass of the main loop, many times a period; the sample comes first. */
void firmware_step(void) {
    sewfast_measurement measurement;
    uint64_t when;
    if (board_measure(&measurement, &when)) {
        board_apply(sewfast_device_sample(device, when, &measurement));
        /* kick the hardware watchdog here, and nowhere else */
    } else {
        board_apply(sewfast_device_poll(device, board_time()));
    }
    communicate();
}
