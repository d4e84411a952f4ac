// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* The wire of cube hubs, version 1: its frames and their bytes, for hubs and hosts.
 *
 * Written from docs/protocol.md, which explains the fields. Portable C11 without heap, operating
 * system or other libraries. All memory is the caller's, every function returns in bounded time,
 * and nothing is static but constant tables: any number of threads may use it, each with decoders
 * and buffers of its own.
 *
 * A hub:                                         A host:
 *
 *     uint8_t out[CUBE_WIRE_SIZE(...)];              cube_decoder decoder;
 *     size_t n = cube_build_sample(                  cube_decoder_init(&decoder, buffer, size);
 *         out, sizeof out, &sample, ...);            while (size > 0) {
 *     uart_write(out, n);                                size_t n = cube_decode(
 *                                                            &decoder, data, size, &frame);
 *                                                        if (frame.type == CUBE_SAMPLE) ...
 *                                                        data += n, size -= n;
 *                                                    }
 *
 * A hub decodes REQUEST in the same way as a host decodes SAMPLE.
 */
#ifndef CUBE_WIRE_H
#define CUBE_WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define CUBE_VERSION 1
#define CUBE_HEADER 4u
#define CUBE_CRC 4u
#define CUBE_MAX_PAYLOAD 65535u
#define CUBE_TEMPERATURE_UNKNOWN INT16_MIN
#define CUBE_NOT_MEASURED 0

/* Largest number of bytes of the COBS encoding of `raw` bytes. COBS adds one byte to each 254, and
 * is never empty. */
#define CUBE_COBS_SIZE(raw) ((raw) + ((raw) + 253u) / 254u + ((raw) == 0u))

/* Largest number of bytes of a frame on the wire, with the zeros before and after it. */
#define CUBE_WIRE_SIZE(payload) (2u + CUBE_COBS_SIZE(CUBE_HEADER + (payload) + CUBE_CRC))

/* Length of each payload, in bytes. */
#define CUBE_HELLO_SIZE(n_cubes) (20u + 8u * (n_cubes))
#define CUBE_SAMPLE_ROW(n_pads) (4u * (n_pads) + 6u)
#define CUBE_SAMPLE_SIZE(n_cubes, n_pads) (20u + (n_cubes) * CUBE_SAMPLE_ROW(n_pads))
#define CUBE_STATS_SIZE 18u
#define CUBE_TIME_SIZE 12u
#define CUBE_REQUEST_SIZE 5u
#define CUBE_ACK_SIZE 6u

/* Largest and smallest number of bytes between the two zeros of a frame, in any version. */
#define CUBE_MAX_RUN CUBE_COBS_SIZE(CUBE_HEADER + CUBE_MAX_PAYLOAD + CUBE_CRC)
#define CUBE_MIN_RUN CUBE_COBS_SIZE(CUBE_HEADER + CUBE_REQUEST_SIZE + CUBE_CRC)

/* Size of the buffer of a decoder for payloads up to `payload` bytes. */
#define CUBE_DECODER_SIZE(payload) \
    (CUBE_COBS_SIZE(CUBE_HEADER + (payload) + CUBE_CRC) + CUBE_GAP)
#define CUBE_GAP 8u

enum cube_type {
    CUBE_NO_FRAME = 0,
    CUBE_HELLO = 0x01,
    CUBE_SAMPLE = 0x02,
    CUBE_STATS = 0x03,
    CUBE_TIME = 0x04,
    CUBE_REQUEST = 0x10,
    CUBE_ACK = 0x11,
};

enum cube_command {
    CUBE_ASK_HELLO = 1,
    CUBE_START = 2,
    CUBE_STOP = 3,
    CUBE_SET_PERIOD = 4, /* argument: sample period, us */
    CUBE_IDENTIFY = 5,   /* argument: how long the hub shows itself, s */
    CUBE_ASK_TIME = 6,   /* argument: a number; CUBE_TIME with that number is the answer, no ACK */
};

enum cube_result {
    CUBE_DONE = 0,
    CUBE_UNKNOWN = 1, /* the hub does not know the request */
    CUBE_REFUSED = 2, /* the hub cannot do it; the argument is the value in force */
};

typedef struct {
    uint64_t hub_uid;
    uint32_t firmware;
    uint16_t n_cubes;
    uint8_t n_pads; /* of each cube */
    uint8_t flags;  /* 0 */
    uint32_t period_us;
} cube_hello;

typedef struct {
    uint32_t sequence;
    uint16_t first_cube;
    uint16_t n_cubes;
    uint64_t device_us; /* middle of the measurement, us since power-up */
    uint8_t n_pads;
} cube_sample;

typedef struct {
    uint64_t uptime_ms;
    uint32_t taken;
    uint32_t dropped;
    uint16_t supply_mv; /* 0: unknown */
} cube_stats;

typedef struct {
    uint32_t number;    /* argument of the request */
    uint64_t device_us; /* now, by the clock of samples */
} cube_time;

typedef struct {
    uint8_t request; /* enum cube_command, or any other number */
    uint32_t argument;
} cube_request;

typedef struct {
    uint8_t request;
    uint8_t result; /* enum cube_result */
    uint32_t argument;
} cube_ack;

/* One decoded frame. `raw` has its `size` bytes from type to CRC; the arrays of HELLO and SAMPLE
 * are read from there by cube_uid(), cube_frequency(), cube_pad_fault() and cube_temperature(). */
typedef struct {
    uint8_t type; /* enum cube_type; CUBE_NO_FRAME: there is none, and all else is undefined */
    const uint8_t *raw;
    size_t size;
    union {
        cube_hello hello;
        cube_sample sample;
        cube_stats stats;
        cube_time time;
        cube_request request;
        cube_ack ack;
    } as;
} cube_frame;

/* Numbers of received bytes and frames, and of runs between zeros that are not a frame; each run is
 * counted exactly once. */
typedef struct {
    uint64_t bytes;
    uint64_t frames;
    uint64_t crc;          /* checksum wrong */
    uint64_t framing;      /* not COBS, or cut off by the end of the stream */
    uint64_t length;       /* too short for a frame, or the length does not fit the contents */
    uint64_t version;      /* checksum right, but another protocol version: see other_version */
    uint64_t unknown_type; /* checksum right, but a type that version 1 does not have */
    uint64_t overrun;      /* longer than any frame, or than the buffer; discarded */
} cube_counters;

/* Decodes bytes to frames. The caller may read only `counters` and `other_version`. */
typedef struct {
    cube_counters counters;
    int other_version; /* last other version of a valid frame; -1: none yet */
    uint8_t *buffer; /* of limit + CUBE_GAP bytes */
    size_t limit;  /* longest run that fits the buffer and can be a frame */
    size_t length; /* bytes of an unfinished run in the buffer */
    bool discarding;
} cube_decoder;

/* Initialises a decoder. false: the buffer is too small even for a REQUEST, and nothing was done.
 *
 * buffer: of `capacity` bytes; the decoder uses it until the end. A hub that receives
 *     requests needs CUBE_DECODER_SIZE(CUBE_REQUEST_SIZE) bytes, a host
 *     CUBE_DECODER_SIZE(CUBE_MAX_PAYLOAD). Longer runs are discarded and count as overrun. */
bool cube_decoder_init(cube_decoder *decoder, uint8_t *buffer, size_t capacity);

/* Decodes bytes up to the end of the next frame, or all of them. Returns the number of bytes used.
 *
 * frame: the frame that they complete, or CUBE_NO_FRAME. Its `raw` lies in the decoder's buffer,
 *     and is valid until the next call for this decoder.
 * The frames and counters do not depend on how a stream is cut into calls. */
size_t cube_decode(cube_decoder *decoder, const uint8_t *data, size_t size, cube_frame *frame);

/* Discards an unfinished run, because the stream ended; it counts as framing. */
void cube_decoder_reset(cube_decoder *decoder);

/* Reads the fields of a frame again, from `raw` and `size` alone, without checking the checksum.
 * false: they are not a SAMPLE. */
bool cube_parse_sample(cube_frame *frame);

/* Fields of a decoded frame. HELLO: uid of a cube, cube < n_cubes. SAMPLE: cube < n_cubes counts
 * from first_cube on, pad < n_pads; mHz, bits and 0.01 degrees Celsius. */
uint64_t cube_uid(const cube_frame *hello, size_t cube);
uint32_t cube_frequency(const cube_frame *sample, size_t cube, size_t pad);
uint32_t cube_pad_fault(const cube_frame *sample, size_t cube);
int16_t cube_temperature(const cube_frame *sample, size_t cube);

/* Where the arrays of a decoded SAMPLE begin in `raw`: little-endian, without alignment. */
const uint8_t *cube_frequency_bytes(const cube_frame *sample);
const uint8_t *cube_pad_fault_bytes(const cube_frame *sample);
const uint8_t *cube_temperature_bytes(const cube_frame *sample);

/* Each of these functions writes one frame to `out`, between two zeros, and returns its length.
 *
 * capacity: at least CUBE_WIRE_SIZE of the payload. If it is less, or the payload would have more
 *     than CUBE_MAX_PAYLOAD bytes, they write nothing and return 0. All of CUBE_WIRE_SIZE may be
 *     written, also where the frame has fewer bytes.
 * cube_uids: n_cubes of them. frequency: mHz, all pads of the first cube, then of the next.
 * pad_fault, temperature: one for each cube; NULL: none has a fault, all are unknown. */
size_t cube_build_hello(
    uint8_t *out, size_t capacity, const cube_hello *hello, const uint64_t *cube_uids);
size_t cube_build_sample(
    uint8_t *out, size_t capacity, const cube_sample *sample, const uint32_t *frequency,
    const uint32_t *pad_fault, const int16_t *temperature);
size_t cube_build_stats(uint8_t *out, size_t capacity, const cube_stats *stats);
size_t cube_build_time(uint8_t *out, size_t capacity, const cube_time *time);
size_t cube_build_request(uint8_t *out, size_t capacity, const cube_request *request);
size_t cube_build_ack(uint8_t *out, size_t capacity, const cube_ack *ack);

/* Returns the number of cubes of n_pads whose SAMPLE frame fits into `wire` bytes; 0 if not even
 * one does. The other cubes need further frames. */
size_t cube_cubes_per_frame(size_t wire, size_t n_pads);

/* Returns the CRC-32 of IEEE 802.3. crc: 0, or the CRC of the bytes before `data`. */
uint32_t cube_crc32(uint32_t crc, const uint8_t *data, size_t size);

/* Encodes `size` bytes with COBS. Returns the length of the code, at most CUBE_COBS_SIZE(size).
 *
 * out: may overlap `data` where it begins at least CUBE_COBS_SIZE(size) - size bytes before it. */
size_t cube_cobs_encode(const uint8_t *data, size_t size, uint8_t *out);

/* Decodes a COBS code. Returns the number of bytes, less than `size`, or CUBE_NOT_COBS.
 *
 * code: `size` bytes, at least one, none of them 0.
 * out: of `size` bytes, all of which may be written. It may overlap `code` where it begins at least
 *     CUBE_GAP bytes before it. */
size_t cube_cobs_decode(const uint8_t *code, size_t size, uint8_t *out);
#define CUBE_NOT_COBS SIZE_MAX

#ifdef __cplusplus
}
#endif

#endif
