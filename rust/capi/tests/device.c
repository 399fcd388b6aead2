/* The C view of a device, under examples/firmware, with a board, a motor and a host in memory.
 *
 * The host's codec is written here from docs/PROTOCOL.md and shares no code with the library. */
#include "board.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHECK(holds)                                                                   \
    do {                                                                               \
        if (!(holds)) {                                                                \
            fprintf(stderr, "%s:%d: does not hold: %s\n", __FILE__, __LINE__, #holds); \
            exit(1);                                                                   \
        }                                                                              \
    } while (0)

/* ---- codec ---- */

static uint32_t crc32(const uint8_t *bytes, size_t count) {
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t k = 0; k < count; k++) {
        crc ^= bytes[k];
        for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ ((crc & 1u) ? 0xEDB88320u : 0u);
    }
    return ~crc;
}

static void put(uint8_t *to, uint64_t value, size_t width) {
    for (size_t k = 0; k < width; k++) to[k] = (uint8_t)(value >> (8 * k));
}

static uint64_t get(const uint8_t *from, size_t width) {
    uint64_t value = 0;
    for (size_t k = 0; k < width; k++) value |= (uint64_t)from[k] << (8 * k);
    return value;
}

static void put_float(uint8_t *to, float value) {
    uint32_t bits;
    memcpy(&bits, &value, 4);
    put(to, bits, 4);
}

static size_t encode(uint8_t *wire, uint8_t kind, uint16_t tag, uint32_t sequence, uint64_t time, const uint8_t *body,
                     size_t length) {
    uint8_t frame[250];
    frame[0] = kind;
    put(frame + 1, tag, 2);
    put(frame + 3, sequence, 4);
    put(frame + 7, time, 8);
    if (length > 0) memcpy(frame + 15, body, length);
    put(frame + 15 + length, crc32(frame, 15 + length), 4);
    size_t code = 0, end = 1;
    for (size_t k = 0; k < 19 + length; k++) {
        if (frame[k] != 0) {
            wire[end++] = frame[k];
        } else {
            wire[code] = (uint8_t)(end - code);
            code = end++;
        }
    }
    wire[code] = (uint8_t)(end - code);
    wire[end++] = 0;
    return end;
}

typedef struct frame {
    uint8_t bytes[256];
    size_t length; /* of the body */
} frame;

/* False where the block is no frame. */
static bool decode(const uint8_t *block, size_t count, frame *frame) {
    size_t at = 0, end = 0;
    while (at < count) {
        size_t code = block[at];
        if (code == 0 || at + code > count) return false;
        if (at > 0) frame->bytes[end++] = 0;
        memcpy(frame->bytes + end, block + at + 1, code - 1);
        end += code - 1;
        at += code;
    }
    if (end < 19) return false;
    frame->length = end - 19;
    return crc32(frame->bytes, end - 4) == get(frame->bytes + end - 4, 4);
}

/* ---- board ---- */

static uint64_t now;
static int32_t counts, pace; /* now, and in a period */
static sewfast_output applied;
static uint8_t to_device[1024];
static size_t to_device_count;
static uint8_t block[256];
static size_t block_length;
static frame last[256]; /* by kind */
static uint32_t heard[256];
static uint64_t samples_heard;

void board_identity(sewfast_identity *identity) {
    static const sewfast_channel channels[] = {
        {SEWFAST_COUNTS, SEWFAST_FROM_COUNTS, 0, 1, "counts", "1"},
        {SEWFAST_STEPS, SEWFAST_FROM_COMMAND, 0, 1000, "u", "V"},
    };
    identity->boot_id = 0x10042;
    identity->entropy = 0x2B7E1516u;
    identity->name = "example drive";
    identity->firmware = "1.0";
    identity->period = 1000;
    identity->counts_per_rev = 1572.0f;
    identity->capabilities =
        SEWFAST_CAN_PROFILE | SEWFAST_CAN_PID | SEWFAST_CAN_DRIVE | SEWFAST_CAN_DESIGN | SEWFAST_CAN_BIQUADS |
        SEWFAST_CAN_FEEDFORWARD |
        SEWFAST_CAN_POSITIONS;
    identity->ceilings = (sewfast_limits){20.0f, 4000.0f, 60000.0f, INFINITY};
    identity->channels = channels;
    identity->channel_count = sizeof channels / sizeof channels[0];
}

uint64_t board_time(void) { return now; }

bool board_measure(sewfast_measurement *measurement, uint64_t *when) {
    if (now % 1000 != 0) return false;
    counts += pace;
    *when = now;
    measurement->counts = counts;
    measurement->current = NAN;
    measurement->further = NULL;
    measurement->further_count = 0;
    return true;
}

void board_apply(sewfast_output output) {
    CHECK(output.enabled || output.u == 0.0f);
    applied = output;
}

size_t board_read(uint8_t *bytes, size_t size) {
    size_t count = to_device_count < size ? to_device_count : size;
    memcpy(bytes, to_device, count);
    memmove(to_device, to_device + count, to_device_count - count);
    to_device_count -= count;
    return count;
}

/* A port that takes at most 17 bytes at a time. */
size_t board_write(const uint8_t *bytes, size_t count) {
    if (count > 17) count = 17;
    for (size_t k = 0; k < count; k++) {
        if (bytes[k] != 0) {
            CHECK(block_length < sizeof block);
            block[block_length++] = bytes[k];
        } else if (block_length > 0) {
            frame frame;
            CHECK(decode(block, block_length, &frame));
            last[frame.bytes[0]] = frame;
            heard[frame.bytes[0]]++;
            if (frame.bytes[0] == 0xC0) samples_heard += (frame.length - 3) / 4;
            block_length = 0;
        }
    }
    return count;
}

/* ---- host ---- */

static const uint16_t TAG = 0x0042;
static uint32_t session = 9;
static uint32_t commands, beats;
static uint32_t key; /* of HELLO's reply */

static void say(uint8_t kind, const uint8_t *body, size_t length) {
    uint32_t sequence = kind == 1 ? 0 : kind < 0x20 ? ++commands : ++beats;
    uint64_t told = kind == 1 ? now : (uint64_t)session << 32 | (uint32_t)now;
    to_device_count += encode(to_device + to_device_count, kind, kind == 1 ? 0 : TAG, sequence, told, body, length);
}

static void steps(int periods) {
    for (int k = 0; k < 8 * periods; k++) {
        now += 125;
        firmware_step();
    }
}

/* The result of a command. */
static int command(uint8_t kind, const uint8_t *body, size_t length) {
    uint32_t before = heard[0x80 | kind];
    say(kind, body, length);
    for (int k = 0; k < 10 && heard[0x80 | kind] == before; k++) steps(1);
    CHECK(heard[0x80 | kind] == before + 1);
    CHECK(get(last[0x80 | kind].bytes + 15, 4) == (kind == 1 ? 0 : commands));
    return last[0x80 | kind].bytes[19];
}

static void drive(float u) {
    uint8_t body[8];
    put(body, 50000, 4);
    put_float(body + 4, u);
    say(0x21, body, 8);
}

/* ---- tests ---- */

static void codec_is_that_of_the_golden_vectors(void) {
    static const uint8_t hello[] = {3, 3, 0x78, 0x56, 0x34, 0x12};
    static const uint8_t golden[] = {0x02, 0x01, 0x01, 0x01, 0x01, 0x01, 0x01, 0x04, 0x40, 0x42, 0x0f, 0x01, 0x01, 0x01, 0x01,
                                     0x0b, 0x03, 0x03, 0x78, 0x56, 0x34, 0x12, 0xc5, 0x5a, 0x3f, 0x7f, 0x00};
    uint8_t wire[256];
    CHECK(encode(wire, 1, 0, 0, 1000000, hello, 6) == sizeof golden);
    CHECK(memcmp(wire, golden, sizeof golden) == 0);
}

static void storage_is_checked(void) {
    static union {
        uint64_t align;
        unsigned char bytes[SEWFAST_DEVICE_SIZE + 8];
    } place;
    static const sewfast_channel channels[] = {
        {SEWFAST_COUNTS, SEWFAST_FROM_COUNTS, 0, 1, "counts", "1"},
        {SEWFAST_STEPS, SEWFAST_FROM_COMMAND, 0, 1000, "u", "V"},
    };
    sewfast_identity identity = {1, 0, "x", "1", 1000, 1572.0f, SEWFAST_CAN_DRIVE, {20, 4000, INFINITY, INFINITY}, channels, 2, 0, 0};
    int32_t refusal = -1;
    CHECK(sewfast_device_size() <= SEWFAST_DEVICE_SIZE && sewfast_device_alignment() <= 8);
    CHECK(sewfast_device_init(&place, SEWFAST_DEVICE_SIZE, &identity, &refusal) != NULL && refusal == SEWFAST_DONE);
    CHECK(sewfast_device_init(NULL, SEWFAST_DEVICE_SIZE, &identity, NULL) == NULL);
    CHECK(sewfast_device_init(&place, sewfast_device_size() - 1, &identity, &refusal) == NULL);
    CHECK(refusal == SEWFAST_REFUSED_STORAGE);
    CHECK(sewfast_device_init(place.bytes + 1, SEWFAST_DEVICE_SIZE, &identity, &refusal) == NULL);
    CHECK(refusal == SEWFAST_REFUSED_STORAGE);
    identity.name = "\xFF";
    CHECK(sewfast_device_init(&place, SEWFAST_DEVICE_SIZE, &identity, &refusal) == NULL && refusal == SEWFAST_REFUSED_TEXT);
    identity.name = "x";
    identity.period = 0;
    CHECK(sewfast_device_init(&place, SEWFAST_DEVICE_SIZE, &identity, &refusal) == NULL && refusal == SEWFAST_REFUSED_PERIOD);
    identity.period = 1000;
    identity.counts_per_rev = 1e-30f; /* a speed would be infinite */
    CHECK(sewfast_device_init(&place, SEWFAST_DEVICE_SIZE, &identity, &refusal) == NULL);
    CHECK(refusal == SEWFAST_REFUSED_COUNTS_PER_REV);
    identity.counts_per_rev = 1572.0f;
    identity.ceilings.volt = 40;
    CHECK(sewfast_device_init(&place, SEWFAST_DEVICE_SIZE, &identity, &refusal) == NULL);
    CHECK(refusal == SEWFAST_REFUSED_CEILINGS);
    identity.ceilings.volt = 20;
    identity.travel_low = 5;
    identity.travel_high = 5;
    CHECK(sewfast_device_init(&place, SEWFAST_DEVICE_SIZE, &identity, &refusal) == NULL);
    CHECK(refusal == SEWFAST_REFUSED_TRAVEL);
    identity.travel_low = -5;
    CHECK(sewfast_device_init(&place, SEWFAST_DEVICE_SIZE, &identity, &refusal) != NULL);
    identity.channel_count = 17;
    CHECK(sewfast_device_init(&place, SEWFAST_DEVICE_SIZE, &identity, &refusal) == NULL);
    CHECK(refusal == SEWFAST_REFUSED_CHANNELS);
    CHECK(!sewfast_device_poll(NULL, 0).enabled && sewfast_device_transmit(NULL, place.bytes, 9) == 0);
}

static void host_is_heard(void) {
    static const uint8_t hello[] = {3, 3, 9, 0, 0, 0};
    uint8_t limits[16];
    CHECK(firmware_init());
    steps(150);
    CHECK(heard[0xC1] == 1 && last[0xC1].bytes[15] == 1); /* boot */
    CHECK(command(1, hello, 6) == 0);
    CHECK(get(last[0x81].bytes + 21, 4) == 0x10042);
    CHECK(memcmp(last[0x81].bytes + 20 + 27, "\x0d" "example drive", 14) == 0);
    key = (uint32_t)get(last[0x81].bytes + 15 + last[0x81].length - 4, 4);
    put_float(limits, 10.0f);
    put_float(limits + 4, 3000.0f);
    put_float(limits + 8, 50000.0f);
    put_float(limits + 12, INFINITY);
    CHECK(command(4, limits, 16) == 0);
}

static void arm_and_start(void) {
    uint8_t arm[8], start[20] = {2};
    put(arm, 50000, 4);
    put(arm + 4, key ^ 1, 4);
    CHECK(command(5, arm, 8) == 13);
    put(arm + 4, key, 4);
    CHECK(command(5, arm, 8) == 0);
    put(start + 1, 50000, 4);
    put(start + 17, 3, 2);
    start[19] = 10;
    CHECK(command(0x0A, start, 20) == 0);
}

static void a_replaced_host_is_not_heard(void) {
    uint32_t last = beats;
    session = 8;
    beats = 1000000;
    for (int k = 0; k < 20; k++) {
        drive(9.0f);
        steps(1);
        CHECK(applied.u == 3.0f);
    }
    session = 9;
    beats = last;
    drive(4.0f);
    steps(2);
    CHECK(applied.u == 4.0f);
}

static void motor_runs_while_the_host_watches(void) {
    arm_and_start();
    for (int k = 0; k < 500; k++) {
        drive(3.0f);
        pace = k < 50 ? k / 10 : 5; /* from rest: 190 RPM within a millisecond would be an acceleration that trips */
        steps(1);
        CHECK(applied.enabled && (k < 2 || applied.u == 3.0f));
    }
    a_replaced_host_is_not_heard();
    drive(99.0f);
    steps(2);
    CHECK(applied.u == 10.0f); /* the limit */
    CHECK(samples_heard >= 490);
    const uint8_t *body = last[0xC0].bytes + 15;
    CHECK(get(body + 1 + 4 + 18, 2) == 3000); /* u of the first sample, in mV */
}

static void silence_stops_it(void) {
    uint64_t fed = now - 2000;
    while (applied.enabled && now < fed + 1000000) steps(1);
    pace = 0;
    CHECK(!applied.enabled && now - fed <= 50000 + 2000);
    steps(20);
    CHECK(last[0xC1].bytes[15] == 6 && last[0xC1].bytes[17] == SEWFAST_WATCHDOG);
    drive(3.0f);
    steps(300);
    CHECK(!applied.enabled);
    CHECK(command(7, NULL, 0) == 0);
    drive(3.0f);
    steps(10);
    CHECK(!applied.enabled);
}

static void stop_is_safe_before_it_is_answered(void) {
    arm_and_start();
    drive(3.0f);
    steps(3);
    CHECK(applied.enabled);
    CHECK(command(6, NULL, 0) == 0 && !applied.enabled);
}

static void pid_is_its_equation(void) {
    static union {
        uint64_t align;
        unsigned char bytes[SEWFAST_PID_SIZE];
    } place;
    sewfast_pid_settings settings = {0.02f, 0.25f, 0.0f,     0.4f,  0.2f, INFINITY, 0.0f,
                                     -20.0f, 20.0f, INFINITY, 0.001f, 0.0f, 1,     0.0f,
                                     INFINITY, 0, {{0.0f, 0.0f, 0.0f, 0.0f}}, 0, {{0.0f, 0.0f, 0.0f, 0.0f}}, 0, 0, 0, 0.0f,
                                     {{0.0f, 0.0f}}, {0.0f}};
    int32_t refusal = -1;
    CHECK(sewfast_pid_size() <= SEWFAST_PID_SIZE);
    sewfast_pid *pid = sewfast_pid_init(&place, sizeof place, &settings, &refusal);
    CHECK(pid != NULL && refusal == 0);
    float expected = 0.02f * 60.0f + 0.02f * 100.0f * 0.001f / 0.25f;
    CHECK(fabsf(sewfast_pid_step(pid, 100.0f, 0.0f) - expected) < 1e-6f);
    CHECK(sewfast_pid_step(pid, 1e6f, 0.0f) == 20.0f);
    sewfast_pid_reset(pid);
    CHECK(fabsf(sewfast_pid_step(pid, 100.0f, 0.0f) - expected) < 1e-6f);
    sewfast_pid_reset(pid);
    CHECK(fabsf(sewfast_pid_step_with(pid, 100.0f, 0.0f, 0.5f) - expected - 0.5f) < 1e-6f);
    CHECK(sewfast_pid_set_manual(pid, -3.0f) && !sewfast_pid_set_manual(pid, NAN));
    CHECK(sewfast_pid_step(pid, 100.0f, 0.0f) == -3.0f);
    sewfast_pid_set_automatic(pid);
    settings.schedule_count = 2;
    settings.schedule[0] = (sewfast_pid_point){0.0f, 0.02f, INFINITY, 0.0f};
    settings.schedule[1] = (sewfast_pid_point){2000.0f, 0.04f, INFINITY, 0.0f};
    CHECK(sewfast_pid_change(pid, &settings) == 0);
    CHECK(fabsf(sewfast_pid_step(pid, 100.0f, 0.0f) + 3.0f) < 1e-5f);
    sewfast_pid_reset(pid);
    CHECK(fabsf(sewfast_pid_step(pid, 1000.0f, 1000.0f) + 0.03f * 0.4f * 1000.0f) < 1e-5f);
    settings.schedule_count = 9;
    CHECK(sewfast_pid_change(pid, &settings) == 16 && sewfast_pid_change(NULL, &settings) == -1);
    settings.schedule_count = 0;
    settings.r_rate = 0.0f;
    CHECK(sewfast_pid_change(pid, &settings) == 15);
    settings.r_rate = INFINITY;
    settings.ti = 0.0f;
    CHECK(sewfast_pid_init(&place, sizeof place, &settings, &refusal) == NULL && refusal == 2);
    CHECK(sewfast_pid_init(&place, 8, &settings, &refusal) == NULL && refusal == -1);

    /* a notch stops its sine, and passes what stands still */
    sewfast_pid_biquad notch = {0.0f, 0.0f, 0.0f, 0.0f};
    CHECK(!sewfast_pid_notch(&notch, 500.0f, 0.0f, 0.5f, 1e-3f) && notch.c0 == 0.0f && notch.a2 == 0.0f);
    CHECK(!sewfast_pid_notch(NULL, 50.0f, 0.0f, 0.5f, 1e-3f) && sewfast_pid_low_pass(&notch, 50.0f, 0.7f, 1e-3f));
    CHECK(sewfast_pid_lead_lag(&notch, 10.0f, 50.0f, 1e-3f) && sewfast_pid_resonance(&notch, 70.0f, 0.02f, 60.0f, 0.3f, 1e-3f));
    CHECK(sewfast_pid_notch(&notch, 50.0f, 0.0f, 0.5f, 1e-3f));
    sewfast_pid_settings stopped = {1.0f, INFINITY, 0.0f,     0.0f,  0.0f, INFINITY, 0.0f,
                                    -20.0f, 20.0f,   INFINITY, 1e-3f, 0.0f, 1,        0.0f, INFINITY, 0,
                                    {{0.0f, 0.0f, 0.0f, 0.0f}}, 1, {notch}, 0, 0, 0, 0.0f, {{0.0f, 0.0f}}, {0.0f}};
    pid = sewfast_pid_init(&place, sizeof place, &stopped, &refusal);
    CHECK(pid != NULL);
    float most = 0.0f;
    for (int k = 0; k < 2000; k++) {
        float u = sewfast_pid_step(pid, 3.0f, 1.0f + sinf(0.314159265f * (float)k));
        most = k > 1900 && fabsf(u - 2.0f) > most ? fabsf(u - 2.0f) : most;
    }
    CHECK(most < 1e-3f);
    stopped.biquads[0].a2 = 1.0f;
    CHECK(sewfast_pid_change(pid, &stopped) == 17);
    stopped.biquad_count = 5;
    CHECK(sewfast_pid_init(&place, sizeof place, &stopped, &refusal) == NULL && refusal == 17);
}

/* A reference two samples early: the command of its level, two of its changes, and the PID on what is expected now. */
static void pid_feeds_its_reference_forward(void) {
    static union {
        uint64_t align;
        unsigned char bytes[SEWFAST_PID_SIZE];
    } place;
    sewfast_pid_settings settings = {0.5f, INFINITY, 0.0f,     0.0f,  0.0f, INFINITY, 0.0f,
                                     -20.0f, 20.0f,  INFINITY, 1e-3f, 0.0f, 1,        0.0f, INFINITY, 0,
                                     {{0.0f, 0.0f, 0.0f, 0.0f}}, 0, {{0.0f, 0.0f, 0.0f, 0.0f}}, 2, 2, 2, 0.5f,
                                     {{-10.0f, -3.0f}, {10.0f, 2.0f}}, {0.75f, -0.25f}};
    int32_t refusal = -1;
    sewfast_pid *pid = sewfast_pid_init(&place, sizeof place, &settings, &refusal);
    CHECK(pid != NULL && refusal == 0);
    const float r[] = {4.0f, 4.0f, 5.0f, 7.0f, 7.0f, 3.0f, 3.0f, NAN, 6.0f};
    float given[4] = {4.0f, 4.0f, 4.0f, 4.0f}; /* the newest first; before the first one it was always the same */
    for (size_t k = 0; k < sizeof r / sizeof r[0]; k++) {
        memmove(given + 1, given, sizeof given - sizeof given[0]);
        given[0] = r[k] == r[k] ? r[k] : given[1];
        const float held = -3.0f + (given[0] + 10.0f) * 5.0f / 20.0f;
        const float changes = 0.75f * (given[0] - given[1]) - 0.25f * (given[1] - given[2]);
        const float expected = given[2] + 0.5f * (given[3] - given[2]);
        const float u = sewfast_pid_step(pid, r[k], 1.0f);
        CHECK(fabsf(u - (0.5f * (expected - 1.0f) + held + changes)) < 1e-5f);
    }
    settings.preview = SEWFAST_PID_AHEAD + 1;
    CHECK(sewfast_pid_change(pid, &settings) == 18);
    settings.preview = SEWFAST_PID_AHEAD;
    CHECK(sewfast_pid_change(pid, &settings) == 0);
    settings.level_count = SEWFAST_PID_LEVELS + 1;
    CHECK(sewfast_pid_change(pid, &settings) == 18);
    settings.level_count = 2;
    settings.tap_count = 200;
    CHECK(sewfast_pid_change(pid, &settings) == 18);
    settings.tap_count = 2;
    settings.late = 1.5f;
    CHECK(sewfast_pid_init(&place, sizeof place, &settings, &refusal) == NULL && refusal == 18);
    settings.late = 0.5f;
    settings.levels[1].y = -10.0f;
    CHECK(sewfast_pid_init(&place, sizeof place, &settings, &refusal) == NULL && refusal == 18);
}

static sewfast_device *computed;

/* A frame to the computed device, which is no part of the firmware. */
static void tell_computed(uint8_t kind, uint16_t tag, const uint8_t *body, size_t length) {
    static uint32_t sequence;
    uint8_t wire[256];
    const uint64_t told = kind == 1 ? 0 : (uint64_t)9 << 32;
    const size_t count = encode(wire, kind, tag, kind == 1 ? 0 : ++sequence, told, body, length);
    sewfast_device_receive(computed, 0, wire, count);
    sewfast_device_poll(computed, 0);
}

static void credit_lets_a_computed_device_advance(void) {
    static union {
        uint64_t align;
        unsigned char bytes[SEWFAST_DEVICE_SIZE];
    } place;
    static const uint8_t hello[] = {3, 3, 9, 0, 0, 0};
    uint8_t credit[12];
    uint64_t until = 77;
    sewfast_identity identity;
    board_identity(&identity);
    identity.capabilities |= SEWFAST_CAN_CREDIT | SEWFAST_COMPUTED;
    computed = sewfast_device_init(&place, sizeof place, &identity, NULL);
    CHECK(computed != NULL && sewfast_device_armed_count(computed) == 0);
    CHECK(!sewfast_device_credit(computed, &until) && until == 77); /* runs by itself */
    tell_computed(1, 0, hello, sizeof hello);
    CHECK(sewfast_device_credit(computed, &until) && until == 0);
    put(credit, 50000, 4);
    put(credit + 4, 123000, 8);
    tell_computed(0x22, TAG, credit, sizeof credit);
    CHECK(sewfast_device_credit(computed, &until) && until == 123000);
    CHECK(sewfast_device_credit(computed, NULL));
    sewfast_device_disconnect(computed);
    CHECK(!sewfast_device_credit(computed, &until) && !sewfast_device_credit(NULL, &until));
    CHECK(sewfast_device_armed_count(NULL) == 0);
}

int main(void) {
    codec_is_that_of_the_golden_vectors();
    storage_is_checked();
    host_is_heard();
    motor_runs_while_the_host_watches();
    silence_stops_it();
    stop_is_safe_before_it_is_answered();
    pid_is_its_equation();
    pid_feeds_its_reference_forward();
    credit_lets_a_computed_device_advance();
    printf("a device takes %zu bytes, a controller %zu\n", sewfast_device_size(), sewfast_pid_size());
    return 0;
}
