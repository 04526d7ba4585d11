/* servo_wire_command.h - commands from `servo-daemon commission` (docs/protocol.md, frame type 4), with the dead man.
 *
 *     static servo_wire_command command = {.most_V = 24.0f};       // your supply
 *     ...
 *     servo_wire_hear(&command, &wire, byte, micros);              // every byte that is received
 *     ...
 *     duty = servo_wire_voltage(&command, micros) / supply_V;      // every sample, in the sampling interrupt
 *     values[4] = command.number;                                  // channel {SERVO_WIRE_COMMAND, SERVO_WIRE_U16, 1, 0}
 *
 * The motor gets 0 V unless a command acts. Call all of it from one context.
 *
 * SPDX-License-Identifier: Apache-2.0
 */
#ifndef SERVO_WIRE_COMMAND_H
#define SERVO_WIRE_COMMAND_H

#include "servo_wire.h"

/* No command acts longer than this, whatever it says: the dead man. */
enum { SERVO_WIRE_HOLD_MS = 50, SERVO_WIRE_COMMAND_SIZE = 12, SERVO_WIRE_ENABLE = 0xA5 };

typedef struct {
    float most_V;       /* yours: a command that asks for more stops the motor */
    uint16_t number;    /* of the command that acts, 0: none */
    /* Its own. */
    float voltage_V;
    uint32_t since_us, valid_us;
    uint8_t frame[SERVO_WIRE_COMMAND_SIZE + 3]; /* CRC and the code byte */
    uint8_t length;     /* beyond the size of `frame`: not a command */
} servo_wire_command;

/* The voltage for the motor from now on. */
static inline float servo_wire_voltage(servo_wire_command *c, uint32_t now_us) {
    if (c->number != 0 && now_us - c->since_us >= c->valid_us) {
        c->number = 0;
    }
    return c->number != 0 ? c->voltage_V : 0.0f;
}

static inline void servo_wire_follow(servo_wire_command *c, const servo_wire *w, const uint8_t *p, uint32_t now_us) {
    const uint16_t number = (uint16_t)(p[4] | p[5] << 8);
    const uint32_t bits = (uint32_t)p[8] | (uint32_t)p[9] << 8 | (uint32_t)p[10] << 16 | (uint32_t)p[11] << 24;
    float voltage;
    memcpy(&voltage, &bits, sizeof voltage);
    if (p[0] != 4 || p[1] != w->drive_id || p[2] != w->session || p[3] != 1 || number == 0) {
        return; /* for somebody else */
    }
    if (p[6] != SERVO_WIRE_ENABLE || !(voltage <= c->most_V && voltage >= -c->most_V)) {
        c->number = 0;
        return;
    }
    servo_wire_voltage(c, now_us);
    if (c->number != 0 ? (uint16_t)(number - c->number - 1) >= 0x7FFF : voltage != 0.0f) {
        return; /* an old one again; from standstill it is 0 V first */
    }
    c->number = number;
    c->voltage_V = voltage;
    c->since_us = now_us;
    c->valid_us = 1000u * (p[7] < SERVO_WIRE_HOLD_MS ? p[7] : SERVO_WIRE_HOLD_MS);
}

/* Takes a byte from the line. */
static inline void servo_wire_hear(servo_wire_command *c, const servo_wire *w, uint8_t byte, uint32_t now_us) {
    uint8_t payload[sizeof c->frame];
    size_t n = 0, at = 0;
    if (byte != 0) {
        if (c->length < sizeof c->frame) {
            c->frame[c->length] = byte;
        }
        c->length = (uint8_t)(c->length <= sizeof c->frame ? c->length + 1 : c->length);
        return;
    }
    const size_t length = c->length;
    c->length = 0;
    if (length != sizeof c->frame) {
        return;
    }
    while (at < length) { /* COBS */
        const size_t end = at + c->frame[at];
        if (end > length) {
            return;
        }
        for (at++; at < end; at++) {
            payload[n++] = c->frame[at];
        }
        if (at < length) {
            payload[n++] = 0;
        }
    }
    if (n == SERVO_WIRE_COMMAND_SIZE + 2 && servo_wire_crc(0xFFFF, payload, n) == 0) {
        servo_wire_follow(c, w, payload, now_us);
    }
}

#endif
