// A speed controller on an Arduino: the two files of `sewfast deploy controller.json sketch` are next to this one.
//
// Use a board with single precision in hardware, such as a Teensy, an ESP32 or a Nano 33 BLE: an AVR takes longer than the
// sample time. Set the three numbers of your drive below.
#include "controller.h"

const int PIN_A = 2, PIN_B = 3, PIN_FORWARD = 5, PIN_BACK = 6;
const float COUNTS_PER_REV = 1572.0f;  // all edges counted
const float SUPPLY = 24.0f;            // V
const uint32_t PERIOD = 1000;          // us, the controller's sample time

static controller_pid pid;
static volatile int32_t counts;
static int32_t counted;
static uint32_t due;

// forward where A leads
static void edge_of_a() { counts += digitalRead(PIN_A) != digitalRead(PIN_B) ? 1 : -1; }
static void edge_of_b() { counts += digitalRead(PIN_A) == digitalRead(PIN_B) ? 1 : -1; }

static void set_voltage(float u) {
    const int duty = (int)(fabsf(u) / SUPPLY * 255.0f + 0.5f);
    analogWrite(PIN_FORWARD, u > 0.0f ? duty : 0);
    analogWrite(PIN_BACK, u < 0.0f ? duty : 0);
}

void setup() {
    pinMode(PIN_A, INPUT_PULLUP);
    pinMode(PIN_B, INPUT_PULLUP);
    attachInterrupt(digitalPinToInterrupt(PIN_A), edge_of_a, CHANGE);
    attachInterrupt(digitalPinToInterrupt(PIN_B), edge_of_b, CHANGE);
    controller_init(&pid);
    due = micros();
}

void loop() {
    if ((int32_t)(micros() - due) < 0) return;
    due += PERIOD;
    noInterrupts();
    const int32_t now = counts;
    interrupts();
    // unsigned, so that the counter may wrap
    const int32_t moved = (int32_t)((uint32_t)now - (uint32_t)counted);
    counted = now;
    const float speed = (float)moved * (60e6f / COUNTS_PER_REV / (float)PERIOD);  // RPM
    set_voltage(controller_step(&pid, 1000.0f, speed));
}
