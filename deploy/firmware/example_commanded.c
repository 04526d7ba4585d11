/* A device that takes commands from standard input, as the binary wire: a small motor, one second.
 *
 *     cc -std=c99 -Wall -o commanded example_commanded.c && ./commanded < commands.bin > capture.bin
 *
 * Replace `motor` by your bridge and converters, `getchar` by your receiver, and the loop by your sampling interrupt.
 *
 * SPDX-License-Identifier: Apache-2.0
 */
#include <stdio.h>

#include "servo_wire_command.h"

static const servo_wire_channel channels[] = {
    {SERVO_WIRE_VOLTAGE, SERVO_WIRE_I16, 0.001f, 0.0f},
    {SERVO_WIRE_CURRENT, SERVO_WIRE_I16, 0.0005f, 0.0f},
    {SERVO_WIRE_POSITION, SERVO_WIRE_I32, 4096.0f, 0.0f},
    {SERVO_WIRE_COMMAND, SERVO_WIRE_U16, 1.0f, 0.0f},
};

static void send(const uint8_t *frame, size_t size) { fwrite(frame, 1, size, stdout); }

/* 1 Ohm, 0.05 V s, 2e-5 kg m2, a millisecond with this voltage. */
static void motor(float voltage, int32_t *values) {
    static float speed, turned;
    const float current = voltage - 0.05f * speed;
    values[0] = (int32_t)(1000.0f * voltage);
    values[1] = (int32_t)(2000.0f * current);
    values[2] = (int32_t)(turned * (4096.0f / 6.2831853f));
    speed += 0.001f * 0.05f * current / 2e-5f;
    turned += 0.001f * speed;
}

int main(void) {
    static servo_wire wire;
    static servo_wire_command command = {.most_V = 24.0f};
    uint8_t frame[SERVO_WIRE_FRAME_SIZE];
    int32_t values[4];

    if (servo_wire_init(&wire, channels, 4) != 0) {
        return 1;
    }
    wire.drive_id = 7;
    wire.session = 1;
    wire.sample_period_ns = 1000000;
    memcpy(wire.identity, "EXAMPLE-0002", 12);
    send(frame, servo_wire_description(&wire, frame));

    for (uint32_t k = 0; k < 1000; k++) {
        const uint32_t micros = 1000 * k;
        int byte = 1;
        while (byte > 0 && (byte = getchar()) != EOF) { /* a frame a sample, if there is one */
            servo_wire_hear(&command, &wire, (uint8_t)byte, micros);
        }
        motor(servo_wire_voltage(&command, micros), values);
        values[3] = command.number;
        if (servo_wire_add(&wire, micros, values) >= 2) { /* at once: who commands waits for it */
            send(frame, servo_wire_samples(&wire, frame));
        }
    }
    return 0;
}
