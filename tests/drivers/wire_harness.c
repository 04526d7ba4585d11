/* servo_wire.h on standard input and output, for test_serial_firmware.py: one command a line, frames come out in hex.
 *
 *   frame HEX | init N [QUANTITY FORMAT SCALE OFFSET]... | set DRIVE SESSION PERIOD MODULUS SEQUENCE IDENTITY_HEX
 *   add T_US VALUE... | skip N | samples | description | hear T_US HEX | voltage T_US
 */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "servo_wire_command.h"

static size_t read_hex(const char *text, uint8_t *out) {
    size_t n = 0;
    unsigned value;
    while (sscanf(text + 2 * n, "%2x", &value) == 1) {
        out[n++] = (uint8_t)value;
    }
    return n;
}

static void print_frame(const uint8_t *frame, size_t size) {
    for (size_t i = 0; i < size; i++) {
        printf("%02x", frame[i]);
    }
    putchar('\n');
}

int main(void) {
    static servo_wire wire;
    static servo_wire_command command = {.most_V = 24.0f};
    static servo_wire_channel channels[16];
    static uint8_t payload[SERVO_WIRE_MAX_PAYLOAD], frame[SERVO_WIRE_FRAME_SIZE];
    static char line[4 * SERVO_WIRE_MAX_PAYLOAD], text[4 * SERVO_WIRE_MAX_PAYLOAD], name[16];
    uint8_t n = 0;

    while (fgets(line, sizeof line, stdin)) {
        char *rest = line;
        int used = 0;
        sscanf(line, "%15s%n", name, &used);
        rest += used;
        if (!strcmp(name, "frame")) {
            sscanf(rest, "%s", text);
            print_frame(frame, servo_wire_frame(payload, read_hex(text, payload), frame));
        } else if (!strcmp(name, "init")) {
            n = (uint8_t)strtoul(rest, &rest, 10);
            for (uint8_t i = 0; i < n; i++) {
                channels[i].quantity = (uint8_t)strtoul(rest, &rest, 10);
                channels[i].format = (uint8_t)strtoul(rest, &rest, 10);
                channels[i].scale = strtof(rest, &rest);
                channels[i].offset = strtof(rest, &rest);
            }
            printf("%d\n", servo_wire_init(&wire, channels, n));
        } else if (!strcmp(name, "set")) {
            wire.drive_id = (uint8_t)strtoul(rest, &rest, 10);
            wire.session = (uint8_t)strtoul(rest, &rest, 10);
            wire.sample_period_ns = (uint32_t)strtoul(rest, &rest, 10);
            wire.position_modulus = (uint32_t)strtoul(rest, &rest, 10);
            wire.sequence = (uint32_t)strtoul(rest, &rest, 10);
            text[0] = 0;
            sscanf(rest, "%s", text);
            read_hex(text, (uint8_t *)wire.identity);
        } else if (!strcmp(name, "add")) {
            int32_t values[16];
            const uint32_t t_us = (uint32_t)strtoul(rest, &rest, 10);
            for (uint8_t i = 0; i < n; i++) {
                values[i] = (int32_t)strtol(rest, &rest, 10);
            }
            printf("%d\n", servo_wire_add(&wire, t_us, values));
        } else if (!strcmp(name, "hear")) {
            const uint32_t t_us = (uint32_t)strtoul(rest, &rest, 10);
            sscanf(rest, "%s", text);
            const size_t size = read_hex(text, payload);
            for (size_t i = 0; i < size; i++) {
                servo_wire_hear(&command, &wire, payload[i], t_us);
            }
        } else if (!strcmp(name, "voltage")) {
            const float voltage = servo_wire_voltage(&command, (uint32_t)strtoul(rest, &rest, 10));
            printf("%u %g\n", command.number, (double)voltage);
        } else if (!strcmp(name, "skip")) {
            servo_wire_skip(&wire, (uint32_t)strtoul(rest, &rest, 10));
        } else if (!strcmp(name, "samples")) {
            print_frame(frame, servo_wire_samples(&wire, frame));
        } else if (!strcmp(name, "description")) {
            print_frame(frame, servo_wire_description(&wire, frame));
        }
    }
    return 0;
}
