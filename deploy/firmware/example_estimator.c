/* A device that estimates its own motor: ten seconds of a motor turning on standard output, as the binary wire with
 * estimates once a second. The estimator comes from `servo-daemon export … --to c --out servo_estimator.c`.
 *
 *     cc -std=c99 -DSERVO_RAD_PER_COUNT=1.53398e-3f -o example example_estimator.c servo_estimator.c -lm
 *     ./example > capture.bin
 *
 * Replace `send` by your UART and `motor` by your converters. On a drive the loop's body is the sampling interrupt, and
 * what is sent goes out of the main loop.
 *
 * SPDX-License-Identifier: Apache-2.0
 */
#include <stdio.h>

#include "servo_estimator.h"
#include "servo_wire.h"

#define PERIOD_S 1e-3f
#define SAMPLES 10000u

static const servo_wire_channel channels[] = {
    {SERVO_WIRE_VOLTAGE, SERVO_WIRE_I16, 0.001f, 0.0f},
    {SERVO_WIRE_CURRENT, SERVO_WIRE_I32, 0.0001f, 0.0f},
    {SERVO_WIRE_POSITION, SERVO_WIRE_I32, 4096.0f, 0.0f},
};

static void send(const uint8_t *frame, size_t size) { fwrite(frame, 1, size, stdout); }

/* A voltage of random steps. */
static float command(uint32_t k) {
    static uint32_t random = 1;
    static float volts;
    if (k % 40 == 0) {
        random = 1664525u * random + 1013904223u;
        volts = 12.0f * ((float)(random >> 8) / 16777216.0f - 0.5f);
    }
    return volts;
}

/* Stands for the motor: R 1.2 Ω, L 1 mH, K 0.057 N m/A, J 5.5e-5 kg m², B 4e-5 N m s/rad, ten steps a sample. */
static void motor(float volts, float *i, float *omega, float *theta) {
    for (int k = 0; k < 10; k++) {
        const float h = PERIOD_S / 10.0f;
        const float di = (volts - 1.2f * *i - 0.057f * *omega) / 1e-3f, dw = (0.057f * *i - 4e-5f * *omega) / 5.5e-5f;
        *theta += h * (*omega + 0.5f * h * dw);
        *i += h * di;
        *omega += h * dw;
    }
}

int main(void) {
    static servo_wire wire;
    static servo_estimator estimator;
    const servo_noise noise = {.voltage_std = 0.01f, .current_std = 0.005f, .position_std = 0.3f * SERVO_RAD_PER_COUNT};
    uint8_t frame[SERVO_WIRE_FRAME_SIZE];
    float i = 0.0f, omega = 0.0f, theta = 0.0f;

    if (servo_wire_init(&wire, channels, 3) != 0) {
        return 1;
    }
    wire.drive_id = 7;
    wire.session = 1;
    wire.sample_period_ns = 1000000;
    memcpy(wire.identity, "EXAMPLE-0002", 12);
#if SERVO_LINEAR
    servo_estimator_start_unknown(&estimator, &noise, 0);
#else /* an exported model with friction or a load starts from its values: `motor` must be the exported one */
    servo_estimator_start(&estimator, &noise, 0, 3.0f);
#endif

    for (uint32_t k = 0; k < SAMPLES; k++) {
        const float volts = command(k);
        const int32_t values[3] = {(int32_t)(1000.0f * volts), (int32_t)(10000.0f * i),
                                   (int32_t)(theta / SERVO_RAD_PER_COUNT + (theta < 0.0f ? -0.5f : 0.5f))};
        servo_estimator_sample(&estimator, PERIOD_S, 0.001f * (float)values[0], 0.0001f * (float)values[1], values[2],
                               SERVO_ALL_VALID);
        if (k % 1000 == 0) {
            send(frame, servo_wire_description(&wire, frame));
        }
        if (servo_wire_add(&wire, 1000 * k, values) >= 10) {
            send(frame, servo_wire_samples(&wire, frame));
        }
        if (k % 1000 == 999) {
            float value[SERVO_PARAMETERS], std[SERVO_PARAMETERS];
            for (int p = 0; p < SERVO_PARAMETERS; p++) {
                value[p] = servo_estimator_value(&estimator, p);
                std[p] = servo_estimator_std(&estimator, p);
            }
            send(frame, servo_wire_estimates(&wire, 1000 * k, (uint8_t)servo_estimator_status(&estimator),
                                             servo_parameter_names, value, std, SERVO_PARAMETERS, frame));
        }
        motor(volts, &i, &omega, &theta);
    }
    return 0;
}
