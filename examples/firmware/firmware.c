/* A drive's firmware around the sewfast device: everything that is not the board.
 *
 *     int main(void) {
 *         board_init();
 *         if (!firmware_init(board_next_boot_id())) halt_with_the_drive_off();
 *         for (;;) firmware_step();
 *     }
 */
#include "board.h"

#include <math.h>

static union {
    uint64_t align;
    unsigned char bytes[SEWFAST_DEVICE_SIZE];
} storage;

static sewfast_device *device;

static const sewfast_channel channels[] = {
    {SEWFAST_COUNTS, SEWFAST_FROM_COUNTS, 0, 1, "counts", "1"},
    {SEWFAST_STEPS, SEWFAST_FROM_COMMAND, 0, 1000, "u", "V"},
    {SEWFAST_FLOAT, SEWFAST_FROM_FEEDBACK, 0, 1, "feedback", "RPM"},
};

/* `boot_id` counts the boots: two in a row must differ in their low 16 bits. */
bool firmware_init(uint32_t boot_id) {
    const sewfast_identity identity = {
        boot_id,
        "example drive",
        "1.0",
        1000,    /* us */
        1572.0f, /* counts per turn */
        SEWFAST_CAN_PROFILE | SEWFAST_CAN_PID | SEWFAST_CAN_DRIVE | SEWFAST_CAN_DESIGN,
        {20.0f, 4000.0f, 60000.0f, INFINITY}, /* what the machine bears */
        channels,
        sizeof channels / sizeof channels[0],
    };
    device = sewfast_device_init(&storage, sizeof storage, &identity, NULL);
    return device != NULL;
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

/* Once round the main loop, many times a period; the sample goes first. */
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
