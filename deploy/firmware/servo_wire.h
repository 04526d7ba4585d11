/* servo_wire.h - the device's side of servo-daemon's binary serial wire, protocol version 1 (docs/protocol.md).
 *
 * C99, one header, no heap, no floating-point arithmetic, nothing of the platform: it fills a buffer, you send it.
 *
 *     static const servo_wire_channel channels[] = {
 *         {SERVO_WIRE_VOLTAGE, SERVO_WIRE_I16, 0.001f, 0.0f},    // 1 mV
 *         {SERVO_WIRE_CURRENT, SERVO_WIRE_I16, 0.001f, 0.0f},    // 1 mA
 *         {SERVO_WIRE_POSITION, SERVO_WIRE_I32, 4096.0f, 0.0f},  // counts per revolution
 *     };
 *     static servo_wire wire;
 *     servo_wire_init(&wire, channels, 3);
 *     ...
 *     uart_send(frame, servo_wire_description(&wire, frame));      // at the start, then once a second
 *     ...
 *     if (servo_wire_add(&wire, micros, values) >= 10)            // every sample
 *         uart_send(frame, servo_wire_samples(&wire, frame));      // every tenth
 *
 * `frame` has SERVO_WIRE_FRAME_SIZE bytes and must stay untouched until it has been sent (DMA: use two).
 * Not reentrant: call everything for one `servo_wire` from one context, or collect in the interrupt and send outside.
 *
 * SPDX-License-Identifier: Apache-2.0
 */
#ifndef SERVO_WIRE_H
#define SERVO_WIRE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define SERVO_WIRE_VERSION 1

/* Largest payload this device sends; 1024 is the most a reader accepts. Define it smaller to save memory. */
#ifndef SERVO_WIRE_MAX_PAYLOAD
#define SERVO_WIRE_MAX_PAYLOAD 256
#endif
#if SERVO_WIRE_MAX_PAYLOAD > 1024
#error "a payload has at most 1024 bytes"
#endif

/* Payload, CRC, one COBS code byte for every 254 bytes begun, delimiter. */
#define SERVO_WIRE_FRAME_SIZE (SERVO_WIRE_MAX_PAYLOAD + 2 + (SERVO_WIRE_MAX_PAYLOAD + 2 + 253) / 254 + 1)

enum { SERVO_WIRE_SAMPLES_HEADER = 12, SERVO_WIRE_DESCRIPTION_HEADER = 29, SERVO_WIRE_CHANNEL_ENTRY = 10 };

typedef enum {
    SERVO_WIRE_VOLTAGE = 1,     /* V */
    SERVO_WIRE_CURRENT = 2,     /* A */
    SERVO_WIRE_POSITION = 3,    /* counts; scale = counts per revolution */
    SERVO_WIRE_VELOCITY = 4,    /* rad/s */
    SERVO_WIRE_TEMPERATURE = 5, /* degrees Celsius */
    SERVO_WIRE_TORQUE = 6,      /* N m */
    SERVO_WIRE_STATUS = 16,     /* SERVO_WIRE_BAD_... bits */
    SERVO_WIRE_COMMAND = 17     /* number of the command that acts: servo_wire_command.h */
} servo_wire_quantity;

typedef enum { SERVO_WIRE_U8 = 1, SERVO_WIRE_I16 = 2, SERVO_WIRE_U16 = 3, SERVO_WIRE_I32 = 4 } servo_wire_format;

/* Bits of a SERVO_WIRE_STATUS channel. */
enum {
    SERVO_WIRE_BAD_VOLTAGE = 0x02,
    SERVO_WIRE_BAD_CURRENT = 0x04,
    SERVO_WIRE_BAD_POSITION = 0x08,
    SERVO_WIRE_SATURATED = 0x20
};

/* value = offset + scale * integer; for a position scale is counts per revolution and offset is in rad. */
typedef struct {
    uint8_t quantity; /* servo_wire_quantity */
    uint8_t format;   /* servo_wire_format */
    float scale;      /* not 0 */
    float offset;
} servo_wire_channel;

typedef struct {
    /* Yours to set after servo_wire_init and before the first frame. */
    uint8_t drive_id;
    uint8_t session;            /* another one after every start, if you can arrange that, and whenever this changes */
    uint32_t sample_period_ns;  /* 0: not regular */
    uint32_t position_modulus;  /* counter wraps from this minus 1 to 0; 0: at the width of its format */
    char identity[16];          /* serial number, padded with zeros */
    uint32_t sequence;          /* number of the next sample */
    /* Its own. */
    const servo_wire_channel *channels;
    uint8_t n_channels;
    uint8_t record_size;
    uint8_t count;
    uint32_t last_us;
    uint16_t length;
    uint8_t payload[SERVO_WIRE_MAX_PAYLOAD];
} servo_wire;

static inline uint8_t servo_wire_format_size(uint8_t format) {
    return format == SERVO_WIRE_U8 ? 1 : format == SERVO_WIRE_I32 ? 4 : 2;
}

static inline void servo_wire_put16(uint8_t *at, uint16_t value) {
    at[0] = (uint8_t)value;
    at[1] = (uint8_t)(value >> 8);
}

static inline void servo_wire_put32(uint8_t *at, uint32_t value) {
    servo_wire_put16(at, (uint16_t)value);
    servo_wire_put16(at + 2, (uint16_t)(value >> 16));
}

static inline void servo_wire_put_float(uint8_t *at, float value) {
    uint32_t bits; /* float is IEEE 754 binary32 on everything that drives a motor */
    memcpy(&bits, &value, sizeof bits);
    servo_wire_put32(at, bits);
}

/* CRC-16/IBM-3740: poly 0x1021, init 0xFFFF, "123456789" gives 0x29B1. Four bits at a time: 32 bytes of table. */
static inline uint16_t servo_wire_crc(uint16_t crc, const uint8_t *data, size_t size) {
    static const uint16_t table[16] = {0x0000, 0x1021, 0x2042, 0x3063, 0x4084, 0x50A5, 0x60C6, 0x70E7,
                                       0x8108, 0x9129, 0xA14A, 0xB16B, 0xC18C, 0xD1AD, 0xE1CE, 0xF1EF};
    while (size--) {
        crc = (uint16_t)((crc << 4) ^ table[(crc >> 12) ^ (*data >> 4)]);
        crc = (uint16_t)((crc << 4) ^ table[(crc >> 12) ^ (*data++ & 0x0F)]);
    }
    return crc;
}

/* Where the stuffed bytes go: `code` is the place of the code byte of the block being filled. */
typedef struct {
    uint8_t *out;
    size_t code, next;
} servo_wire_stuffer;

static inline void servo_wire_stuff(servo_wire_stuffer *s, const uint8_t *data, size_t size) {
    while (size--) {
        /* A full block is closed only when another byte follows, so that 254 bytes take one code byte, not two. */
        if (s->next - s->code == 0xFF) {
            s->out[s->code] = 0xFF;
            s->code = s->next++;
        }
        if (*data != 0) {
            s->out[s->next++] = *data;
        } else {
            s->out[s->code] = (uint8_t)(s->next - s->code);
            s->code = s->next++;
        }
        data++;
    }
}

/* A payload as a frame: CRC, COBS, delimiter. Returns its size; `out` has SERVO_WIRE_FRAME_SIZE bytes. */
static inline size_t servo_wire_frame(const uint8_t *payload, size_t size, uint8_t *out) {
    const uint16_t crc = servo_wire_crc(0xFFFF, payload, size);
    const uint8_t tail[2] = {(uint8_t)(crc >> 8), (uint8_t)crc}; /* high byte first: CRC over all is then 0 */
    servo_wire_stuffer s = {out, 0, 1};
    servo_wire_stuff(&s, payload, size);
    servo_wire_stuff(&s, tail, sizeof tail);
    out[s.code] = (uint8_t)(s.next - s.code);
    out[s.next++] = 0;
    return s.next;
}

/* Start. `channels` is kept, not copied. Returns 0, or -1 when a description or a sample would not fit the payload. */
static inline int servo_wire_init(servo_wire *w, const servo_wire_channel *channels, uint8_t n_channels) {
    size_t record = 2;
    memset(w, 0, sizeof *w);
    for (uint8_t i = 0; i < n_channels; i++) {
        record += servo_wire_format_size(channels[i].format);
    }
    w->channels = channels;
    w->n_channels = n_channels;
    w->record_size = (uint8_t)record;
    w->length = SERVO_WIRE_SAMPLES_HEADER;
    return n_channels > 0 && record <= 255 && SERVO_WIRE_SAMPLES_HEADER + record <= SERVO_WIRE_MAX_PAYLOAD &&
                   SERVO_WIRE_DESCRIPTION_HEADER + n_channels * SERVO_WIRE_CHANNEL_ENTRY <= SERVO_WIRE_MAX_PAYLOAD
               ? 0
               : -1;
}

/* The description frame. Returns its size. Does not disturb the samples collected so far. */
static inline size_t servo_wire_description(const servo_wire *w, uint8_t *out) {
    uint8_t payload[SERVO_WIRE_MAX_PAYLOAD];
    uint8_t *at = payload + SERVO_WIRE_DESCRIPTION_HEADER;
    payload[0] = 2;
    payload[1] = w->drive_id;
    payload[2] = w->session;
    payload[3] = SERVO_WIRE_VERSION;
    servo_wire_put32(payload + 4, w->sample_period_ns);
    servo_wire_put32(payload + 8, w->position_modulus);
    memcpy(payload + 12, w->identity, sizeof w->identity);
    payload[28] = w->n_channels;
    for (uint8_t i = 0; i < w->n_channels; i++, at += SERVO_WIRE_CHANNEL_ENTRY) {
        at[0] = w->channels[i].quantity;
        at[1] = w->channels[i].format;
        servo_wire_put_float(at + 2, w->channels[i].scale);
        servo_wire_put_float(at + 6, w->channels[i].offset);
    }
    return servo_wire_frame(payload, (size_t)(at - payload), out);
}

/* Collect a sample taken at `t_us` (a free-running counter of 32 bits); `values` in the order of the channels, wrapped
 * to their formats. Returns how many samples are collected, or 0 if this one does not fit into the current frame (frame
 * full, or more than 65535 us, or no time at all, since the sample before): send the frame, then add it again. */
static inline int servo_wire_add(servo_wire *w, uint32_t t_us, const int32_t *values) {
    const uint32_t step_us = w->count ? t_us - w->last_us : 0;
    uint8_t *at = w->payload + w->length;
    if (w->count == 255 || w->length + w->record_size > SERVO_WIRE_MAX_PAYLOAD || step_us > 0xFFFF ||
        (w->count && step_us == 0)) {
        return 0;
    }
    if (w->count == 0) {
        servo_wire_put32(w->payload + 4, w->sequence);
        servo_wire_put32(w->payload + 8, t_us);
    }
    servo_wire_put16(at, (uint16_t)step_us);
    at += 2;
    for (uint8_t i = 0; i < w->n_channels; i++) {
        const uint8_t size = servo_wire_format_size(w->channels[i].format);
        for (uint8_t k = 0; k < size; k++) {
            *at++ = (uint8_t)((uint32_t)values[i] >> (8 * k));
        }
    }
    w->length = (uint16_t)(w->length + w->record_size);
    w->last_us = t_us;
    w->sequence++;
    return ++w->count;
}

/* The collected samples as a frame, and start collecting anew. Returns its size, 0 without samples. */
static inline size_t servo_wire_samples(servo_wire *w, uint8_t *out) {
    size_t size;
    if (w->count == 0) {
        return 0;
    }
    w->payload[0] = 1;
    w->payload[1] = w->drive_id;
    w->payload[2] = w->session;
    w->payload[3] = w->count;
    size = servo_wire_frame(w->payload, w->length, out);
    w->count = 0;
    w->length = SERVO_WIRE_SAMPLES_HEADER;
    return size;
}

/* What the device itself estimates, frame type 3: n parameters (at most (SERVO_WIRE_MAX_PAYLOAD - 9) / 16) with their
 * names, values and standard deviations (NAN: not known) in SI units, `status` as servo_status of the exported
 * estimator. Returns its size. Once a second is enough. */
static inline size_t servo_wire_estimates(const servo_wire *w, uint32_t t_us, uint8_t status, const char (*names)[8],
                                          const float *values, const float *stds, uint8_t n, uint8_t *out) {
    uint8_t payload[SERVO_WIRE_MAX_PAYLOAD];
    uint8_t *at = payload + 9;
    if (9u + 16u * n > SERVO_WIRE_MAX_PAYLOAD) {
        return 0;
    }
    payload[0] = 3;
    payload[1] = w->drive_id;
    payload[2] = w->session;
    payload[3] = n;
    servo_wire_put32(payload + 4, t_us);
    payload[8] = status;
    for (uint8_t i = 0; i < n; i++, at += 16) {
        memcpy(at, names[i], 8);
        servo_wire_put_float(at + 8, values[i]);
        servo_wire_put_float(at + 12, stds[i]);
    }
    return servo_wire_frame(payload, (size_t)(at - payload), out);
}

/* The device itself lost `n` samples: send what is collected first, then tell the numbering. */
static inline void servo_wire_skip(servo_wire *w, uint32_t n) { w->sequence += n; }

#endif
