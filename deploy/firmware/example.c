/* A device on standard output: three seconds of a motor turning, as the binary wire.
 *
 *     cc -std=c99 -Wall -o example example.c && ./example > capture.bin
 *
 * Replace `send` by your UART, `sample` by your converters and timer, and the loop by your sampling interrupt.
 *
 * SPDX-License-Identifier: Apache-2.0
 */
#include <stdio.h>

#include "servo_wire.h"

static const servo_wire_channel channels[] = {
    {SERVO_WIRE_VOLTAGE, SERVO_WIRE_I16, 0.001f, 0.0f},
    {SERVO_WIRE_CURRENT, SERVO_WIRE_I16, 0.0005f, 0.0f},
    {SERVO_WIRE_POSITION, SERVO_WIRE_I32, 4096.0f, 0.0f},
    {SERVO_WIRE_STATUS, SERVO_WIRE_U8, 1.0f, 0.0f},
};

static void send(const uint8_t *frame, size_t size) { fwrite(frame, 1, size, stdout); }

/* 6 V and 0.25 A, reversed every 500 samples, at two revolutions a second. */
static void sample(uint32_t k, int32_t *values) {
    const int32_t sign = (k / 500) % 2 ? -1 : 1;
    const int32_t phase = (int32_t)(k % 500);
    values[0] = sign * 6000;
    values[1] = sign * 500;
    values[2] = (sign > 0 ? phase : 500 - phase) * 8;
    values[3] = 0;
}

int main(void) {
    static servo_wire wire;
    uint8_t frame[SERVO_WIRE_FRAME_SIZE];
    int32_t values[4];

    if (servo_wire_init(&wire, channels, 4) != 0) {
        return 1;
    }
    wire.drive_id = 7;
    wire.session = 1;
    wire.sample_period_ns = 1000000;
    memcpy(wire.identity, "EXAMPLE-0001", 12);

    for (uint32_t k = 0; k < 3000; k++) {
        if (k % 1000 == 0) {
            send(frame, servo_wire_description(&wire, frame));
        }
        sample(k, values);
        if (servo_wire_add(&wire, 1000 * k, values) >= 10) {
            send(frame, servo_wire_samples(&wire, frame));
        }
    }
    return 0;
}
