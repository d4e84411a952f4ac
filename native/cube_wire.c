// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* See cube_wire.h. */
#include "cube_wire.h"

#include <string.h>

/* ------------------------------------------------------------------ little-endian numbers ---- */

static uint16_t load_u16(const uint8_t *at) {
    return (uint16_t)(at[0] | at[1] << 8);
}

static uint32_t load_u32(const uint8_t *at) {
    return (uint32_t)load_u16(at) | (uint32_t)load_u16(at + 2) << 16;
}

static uint64_t load_u64(const uint8_t *at) {
    return (uint64_t)load_u32(at) | (uint64_t)load_u32(at + 4) << 32;
}

/* Each function writes a number and returns the address after it. */

static uint8_t *store_u8(uint8_t *at, uint8_t value) {
    *at = value;
    return at + 1;
}

static uint8_t *store_u16(uint8_t *at, uint16_t value) {
    return store_u8(store_u8(at, (uint8_t)(value & 0xFF)), (uint8_t)(value >> 8));
}

static uint8_t *store_u32(uint8_t *at, uint32_t value) {
    return store_u16(store_u16(at, (uint16_t)(value & 0xFFFF)), (uint16_t)(value >> 16));
}

static uint8_t *store_u64(uint8_t *at, uint64_t value) {
    return store_u32(store_u32(at, (uint32_t)(value & 0xFFFFFFFF)), (uint32_t)(value >> 32));
}

/* --------------------------------------------------------------------------------- CRC-32 ---- */

/* Row k holds, for each value of a byte, the CRC of this byte and k zero bytes after it. A CRC is
 * linear: the CRC of a byte is the exclusive or of the CRCs of its bits, so eight constants determine
 * the 256 entries of a row. */
#define ENTRIES(a, b, c, d, e, f, g, h) E8(0u, a, b, c, d, e, f, g, h)
#define E1(v, a) (v), ((v) ^ (a))
#define E2(v, a, b) E1(v, a), E1((v) ^ (b), a)
#define E3(v, a, b, c) E2(v, a, b), E2((v) ^ (c), a, b)
#define E4(v, a, b, c, d) E3(v, a, b, c), E3((v) ^ (d), a, b, c)
#define E5(v, a, b, c, d, e) E4(v, a, b, c, d), E4((v) ^ (e), a, b, c, d)
#define E6(v, a, b, c, d, e, f) E5(v, a, b, c, d, e), E5((v) ^ (f), a, b, c, d, e)
#define E7(v, a, b, c, d, e, f, g) E6(v, a, b, c, d, e, f), E6((v) ^ (g), a, b, c, d, e, f)
#define E8(v, a, b, c, d, e, f, g, h) \
    E7(v, a, b, c, d, e, f, g), E7((v) ^ (h), a, b, c, d, e, f, g)

/* A hub with little flash compiles with CUBE_WIRE_SMALL: one row, 1 kB, instead of sixteen. */
static const uint32_t crc_table[][256] = {
    {ENTRIES(0x77073096, 0xee0e612c, 0x076dc419, 0x0edb8832,
             0x1db71064, 0x3b6e20c8, 0x76dc4190, 0xedb88320)},
#ifndef CUBE_WIRE_SMALL
    {ENTRIES(0x191b3141, 0x32366282, 0x646cc504, 0xc8d98a08,
             0x4ac21251, 0x958424a2, 0xf0794f05, 0x3b83984b)},
    {ENTRIES(0x01c26a37, 0x0384d46e, 0x0709a8dc, 0x0e1351b8,
             0x1c26a370, 0x384d46e0, 0x709a8dc0, 0xe1351b80)},
    {ENTRIES(0xb8bc6765, 0xaa09c88b, 0x8f629757, 0xc5b428ef,
             0x5019579f, 0xa032af3e, 0x9b14583d, 0xed59b63b)},
    {ENTRIES(0x3d6029b0, 0x7ac05360, 0xf580a6c0, 0x30704bc1,
             0x60e09782, 0xc1c12f04, 0x58f35849, 0xb1e6b092)},
    {ENTRIES(0xcb5cd3a5, 0x4dc8a10b, 0x9b914216, 0xec53826d,
             0x03d6029b, 0x07ac0536, 0x0f580a6c, 0x1eb014d8)},
    {ENTRIES(0xa6770bb4, 0x979f1129, 0xf44f2413, 0x33ef4e67,
             0x67de9cce, 0xcfbd399c, 0x440b7579, 0x8816eaf2)},
    {ENTRIES(0xccaa009e, 0x4225077d, 0x844a0efa, 0xd3e51bb5,
             0x7cbb312b, 0xf9766256, 0x299dc2ed, 0x533b85da)},
    {ENTRIES(0x177b1443, 0x2ef62886, 0x5dec510c, 0xbbd8a218,
             0xacc04271, 0x82f182a3, 0xde920307, 0x6655004f)},
    {ENTRIES(0xefc26b3e, 0x04f5d03d, 0x09eba07a, 0x13d740f4,
             0x27ae81e8, 0x4f5d03d0, 0x9eba07a0, 0xe6050901)},
    {ENTRIES(0xc18edfc0, 0x586cb9c1, 0xb0d97382, 0xbac3e145,
             0xaef6c4cb, 0x869c8fd7, 0xd64819ef, 0x77e1359f)},
    {ENTRIES(0x9ba54c6f, 0xec3b9e9f, 0x03063b7f, 0x060c76fe,
             0x0c18edfc, 0x1831dbf8, 0x3063b7f0, 0x60c76fe0)},
    {ENTRIES(0xdd96d985, 0x605cb54b, 0xc0b96a96, 0x5a03d36d,
             0xb407a6da, 0xb37e4bf5, 0xbd8d91ab, 0xa06a2517)},
    {ENTRIES(0x9d0fe176, 0xe16ec4ad, 0x19ac8f1b, 0x33591e36,
             0x66b23c6c, 0xcd6478d8, 0x41b9f7f1, 0x8373efe2)},
    {ENTRIES(0xb9fbdbe8, 0xa886b191, 0x8a7c6563, 0xcf89cc87,
             0x44629f4f, 0x88c53e9e, 0xcafb7b7d, 0x4e87f0bb)},
    {ENTRIES(0xae689191, 0x87a02563, 0xd4314c87, 0x73139f4f,
             0xe6273e9e, 0x173f7b7d, 0x2e7ef6fa, 0x5cfdedf4)},
#endif
};

/* The CRC of data followed by its own CRC is this constant, so the CRC need not be cut off. */
#define CRC_RESIDUE 0x2144DF1Cu

#ifndef CUBE_WIRE_SMALL
/* Returns the contribution of four bytes to the CRC of data in which `behind` bytes follow them. */
static uint32_t crc_of_four(uint32_t bytes, int behind) {
    return crc_table[behind + 3][bytes & 0xFF] ^ crc_table[behind + 2][bytes >> 8 & 0xFF] ^
           crc_table[behind + 1][bytes >> 16 & 0xFF] ^ crc_table[behind][bytes >> 24];
}
#endif

uint32_t cube_crc32(uint32_t crc, const uint8_t *data, size_t size) {
    crc = ~crc;
#ifndef CUBE_WIRE_SMALL
    for (; size >= 16; data += 16, size -= 16)
        crc = crc_of_four(load_u32(data) ^ crc, 12) ^ crc_of_four(load_u32(data + 4), 8) ^
              crc_of_four(load_u32(data + 8), 4) ^ crc_of_four(load_u32(data + 12), 0);
    for (; size >= 4; data += 4, size -= 4)
        crc = crc_of_four(load_u32(data) ^ crc, 0);
#endif
    for (; size > 0; data++, size--)
        crc = crc >> 8 ^ crc_table[0][(crc ^ *data) & 0xFF];
    return ~crc;
}

/* ----------------------------------------------------------------------------------- COBS ---- */

size_t cube_cobs_encode(const uint8_t *data, size_t size, uint8_t *out) {
    size_t code = 0; /* index at which the code byte of the present block is written */
    size_t at = 1;
    for (size_t i = 0; i < size; i++) {
        if (at - code == 255) { /* the block is full, and more follows */
            out[code] = 255;
            code = at++;
        }
        uint8_t byte = data[i];
        if (byte == 0) {
            out[code] = (uint8_t)(at - code);
            code = at++;
        } else {
            out[at++] = byte;
        }
    }
    out[code] = (uint8_t)(at - code);
    return at;
}

size_t cube_cobs_decode(const uint8_t *code, size_t size, uint8_t *out) {
    const uint8_t *end = code + size;
    uint8_t *to = out;
    while (code < end) {
        if (*code == 1) { /* successive zeros are common, and this branch is faster for them */
            code++;
            *to = 0;
            to += code < end;
            continue;
        }
        size_t length = (size_t)*code++ - 1; /* bytes of this block */
        size_t left = (size_t)(end - code);
        if (length > left)
            return CUBE_NOT_COBS;
        size_t i = 0;
        /* Short blocks are copied faster in words of 8 bytes. The last word may contain bytes of the
         * next block, which are overwritten when that block is decoded. */
        for (; i < length && i + 8 <= left; i += 8) {
            uint64_t word;
            memcpy(&word, code + i, 8);
            memcpy(to + i, &word, 8);
        }
        for (; i < length; i++)
            to[i] = code[i];
        to += length;
        code += length;
        if (length < 254 && code < end)
            *to++ = 0;
    }
    return (size_t)(to - out);
}

/* -------------------------------------------------------------------------------- decoder ---- */

bool cube_decoder_init(cube_decoder *decoder, uint8_t *buffer, size_t capacity) {
    if (capacity < CUBE_DECODER_SIZE(CUBE_REQUEST_SIZE))
        return false;
    memset(decoder, 0, sizeof *decoder);
    decoder->other_version = -1;
    decoder->buffer = buffer;
    decoder->limit = capacity - CUBE_GAP;
    if (decoder->limit > CUBE_MAX_RUN)
        decoder->limit = CUBE_MAX_RUN;
    return true;
}

void cube_decoder_reset(cube_decoder *decoder) {
    decoder->counters.framing += decoder->length > 0;
    decoder->length = 0;
    decoder->discarding = false;
}

/* Reads the fields of a frame with a correct checksum. Returns false if the length of the frame
 * contradicts its fields. */
static bool parse(cube_frame *frame) {
    const uint8_t *at = frame->raw + CUBE_HEADER;
    size_t size = load_u16(frame->raw + 2);
    if (size + CUBE_HEADER + CUBE_CRC != frame->size)
        return false;
    switch (frame->type) {
    case CUBE_HELLO:
        if (size < CUBE_HELLO_SIZE(0))
            return false;
        frame->as.hello = (cube_hello){
            .hub_uid = load_u64(at),
            .firmware = load_u32(at + 8),
            .n_cubes = load_u16(at + 12),
            .n_pads = at[14],
            .flags = at[15],
            .period_us = load_u32(at + 16),
        };
        return size == CUBE_HELLO_SIZE(frame->as.hello.n_cubes);
    case CUBE_SAMPLE:
        if (size < CUBE_SAMPLE_SIZE(0, 0))
            return false;
        frame->as.sample = (cube_sample){
            .sequence = load_u32(at),
            .first_cube = load_u16(at + 4),
            .n_cubes = load_u16(at + 6),
            .device_us = load_u64(at + 8),
            .n_pads = at[16],
        };
        return size == CUBE_SAMPLE_SIZE(frame->as.sample.n_cubes, frame->as.sample.n_pads);
    case CUBE_STATS:
        if (size != CUBE_STATS_SIZE)
            return false;
        frame->as.stats = (cube_stats){
            .uptime_ms = load_u64(at),
            .taken = load_u32(at + 8),
            .dropped = load_u32(at + 12),
            .supply_mv = load_u16(at + 16),
        };
        return true;
    case CUBE_TIME:
        if (size != CUBE_TIME_SIZE)
            return false;
        frame->as.time = (cube_time){.number = load_u32(at), .device_us = load_u64(at + 4)};
        return true;
    case CUBE_REQUEST:
        if (size != CUBE_REQUEST_SIZE)
            return false;
        frame->as.request = (cube_request){.request = at[0], .argument = load_u32(at + 1)};
        return true;
    default: /* CUBE_ACK */
        if (size != CUBE_ACK_SIZE)
            return false;
        frame->as.ack =
            (cube_ack){.request = at[0], .result = at[1], .argument = load_u32(at + 2)};
        return true;
    }
}

bool cube_parse_sample(cube_frame *frame) {
    if (frame->size < CUBE_HEADER + CUBE_CRC || frame->raw[0] != CUBE_SAMPLE)
        return false;
    frame->type = CUBE_SAMPLE;
    return parse(frame);
}

static bool is_known(uint8_t type) {
    return (type >= CUBE_HELLO && type <= CUBE_TIME) || type == CUBE_REQUEST || type == CUBE_ACK;
}

/* Returns the address of the bytes of an unfinished run. They are kept CUBE_GAP bytes after the address
 * to which they will be decoded. */
static uint8_t *kept(cube_decoder *decoder) {
    return decoder->buffer + CUBE_GAP;
}

/* Decodes a run (bytes between two zeros) of CUBE_MIN_RUN to `limit` bytes to a frame, or counts the
 * kind of error.
 *
 * run: bytes in the caller's data, or those that `kept` returns. */
static uint8_t check_run(
    cube_decoder *decoder, const uint8_t *run, size_t length, cube_frame *frame) {
    cube_counters *counters = &decoder->counters;
    uint8_t *raw = decoder->buffer;
    size_t size = cube_cobs_decode(run, length, raw);
    if (size == CUBE_NOT_COBS) {
        counters->framing++;
    } else if (cube_crc32(0, raw, size) != CRC_RESIDUE) {
        counters->crc++;
    } else if (raw[1] != CUBE_VERSION) {
        counters->version++;
        decoder->other_version = raw[1];
    } else if (!is_known(raw[0])) {
        counters->unknown_type++;
    } else {
        frame->type = raw[0];
        frame->raw = raw;
        frame->size = size;
        if (parse(frame)) {
            counters->frames++;
            return frame->type;
        }
        counters->length++;
    }
    return CUBE_NO_FRAME;
}

/* Adds bytes to the unfinished run, or discards the run if it becomes too long. */
static void keep(cube_decoder *decoder, const uint8_t *data, size_t size) {
    if (decoder->discarding)
        return;
    if (size > decoder->limit - decoder->length) {
        decoder->counters.overrun++;
        decoder->length = 0;
        decoder->discarding = true;
        return;
    }
    memcpy(kept(decoder) + decoder->length, data, size);
    decoder->length += size;
}

/* Adds the last bytes of a run, after which a zero follows, and decodes the run. */
static uint8_t close_run(
    cube_decoder *decoder, const uint8_t *data, size_t size, cube_frame *frame) {
    if (decoder->length > 0 || decoder->discarding || size > decoder->limit) {
        keep(decoder, data, size);
        data = kept(decoder);
        size = decoder->length;
        decoder->length = 0;
        decoder->discarding = false;
    }
    if (size >= CUBE_MIN_RUN)
        return check_run(decoder, data, size, frame);
    decoder->counters.length += size > 0;
    return CUBE_NO_FRAME;
}

#define LOW_BITS 0x7F7F7F7F7F7F7F7Fu
#define ONES 0x0101010101010101u

/* Skips runs that end within the next 8 bytes and are therefore shorter than any frame. Returns the
 * number of skipped bytes, which is 0 if there is no zero among the 8 bytes.
 *
 * Noise may contain a zero at every other byte. A search for each zero would make it slower to decode
 * than good frames.
 *
 * data: 8 bytes at the start of a run. */
static size_t skip_short_runs(cube_decoder *decoder, const uint8_t *data) {
    uint64_t word = load_u64(data);
    /* The high bit is set in each byte that is zero in `word`, and all other bits are 0. */
    uint64_t zeros = ~(((word & LOW_BITS) + LOW_BITS) | word | LOW_BITS);
    /* A run ends at a zero whose preceding byte is not zero. The byte before `data` is a zero. */
    uint64_t ends = (zeros & ~(zeros << 8 | 0x80)) >> 7;
    decoder->counters.length += ends * ONES >> 56;
    size_t taken = zeros != 0;
    for (unsigned bits = 32; bits >= 8; bits /= 2) {
        unsigned shift = zeros >> bits ? bits : 0;
        taken += shift / 8;
        zeros >>= shift;
    }
    return taken;
}

size_t cube_decode(cube_decoder *decoder, const uint8_t *data, size_t size, cube_frame *frame) {
    size_t at = 0;
    frame->type = CUBE_NO_FRAME;
    while (at < size && frame->type == CUBE_NO_FRAME) {
        size_t from = at; /* where to look for a zero */
        if (decoder->length == 0 && !decoder->discarding && size - at >= 8) {
            size_t taken = skip_short_runs(decoder, data + at);
            if (taken > 0) {
                at += taken;
                continue;
            }
            from += 8;
        }
        const uint8_t *zero = memchr(data + from, 0, size - from);
        if (zero == NULL) {
            keep(decoder, data + at, size - at);
            at = size;
        } else {
            size_t end = (size_t)(zero - data);
            frame->type = close_run(decoder, data + at, end - at, frame);
            at = end + 1;
        }
    }
    decoder->counters.bytes += at;
    return at;
}

uint64_t cube_uid(const cube_frame *hello, size_t cube) {
    return load_u64(hello->raw + CUBE_HEADER + CUBE_HELLO_SIZE(cube));
}

const uint8_t *cube_frequency_bytes(const cube_frame *sample) {
    return sample->raw + CUBE_HEADER + CUBE_SAMPLE_SIZE(0, 0);
}

const uint8_t *cube_pad_fault_bytes(const cube_frame *sample) {
    size_t n_values = (size_t)sample->as.sample.n_cubes * sample->as.sample.n_pads;
    return cube_frequency_bytes(sample) + 4 * n_values;
}

const uint8_t *cube_temperature_bytes(const cube_frame *sample) {
    return cube_pad_fault_bytes(sample) + 4 * (size_t)sample->as.sample.n_cubes;
}

uint32_t cube_frequency(const cube_frame *sample, size_t cube, size_t pad) {
    return load_u32(cube_frequency_bytes(sample) + 4 * (cube * sample->as.sample.n_pads + pad));
}

uint32_t cube_pad_fault(const cube_frame *sample, size_t cube) {
    return load_u32(cube_pad_fault_bytes(sample) + 4 * cube);
}

int16_t cube_temperature(const cube_frame *sample, size_t cube) {
    uint16_t bits = load_u16(cube_temperature_bytes(sample) + 2 * cube);
    return (int16_t)(bits < 0x8000 ? bits : (int32_t)bits - 0x10000);
}

/* ------------------------------------------------------------------------------- building ---- */

/* Returns the offset in `out` of the bytes of a frame before their COBS encoding. The encoding is
 * written into `out` from the second byte on, and the offset is so large that it never overwrites
 * bytes that are not encoded yet. */
static size_t raw_offset(size_t payload) {
    size_t raw = CUBE_HEADER + payload + CUBE_CRC;
    return 1 + CUBE_COBS_SIZE(raw) - raw;
}

/* Writes the header of a frame. Returns the address for the payload, or NULL if it does not fit. */
static uint8_t *open_frame(uint8_t *out, size_t capacity, uint8_t type, size_t payload) {
    if (payload > CUBE_MAX_PAYLOAD || capacity < CUBE_WIRE_SIZE(payload))
        return NULL;
    uint8_t *at = store_u8(out + raw_offset(payload), type);
    return store_u16(store_u8(at, CUBE_VERSION), (uint16_t)payload);
}

/* Adds the CRC, encodes the frame with COBS in place, and puts it between two zeros. Returns the number
 * of bytes on the wire.
 *
 * end: address after the payload. */
static size_t close_frame(uint8_t *out, uint8_t *end, size_t payload) {
    uint8_t *raw = out + raw_offset(payload);
    store_u32(end, cube_crc32(0, raw, CUBE_HEADER + payload));
    size_t size = cube_cobs_encode(raw, CUBE_HEADER + payload + CUBE_CRC, out + 1);
    out[0] = 0;
    out[size + 1] = 0;
    return size + 2;
}

size_t cube_build_hello(
    uint8_t *out, size_t capacity, const cube_hello *hello, const uint64_t *cube_uids) {
    size_t payload = CUBE_HELLO_SIZE(hello->n_cubes);
    uint8_t *at = open_frame(out, capacity, CUBE_HELLO, payload);
    if (at == NULL)
        return 0;
    at = store_u64(at, hello->hub_uid);
    at = store_u32(at, hello->firmware);
    at = store_u16(at, hello->n_cubes);
    at = store_u8(at, hello->n_pads);
    at = store_u8(at, hello->flags);
    at = store_u32(at, hello->period_us);
    for (size_t i = 0; i < hello->n_cubes; i++)
        at = store_u64(at, cube_uids[i]);
    return close_frame(out, at, payload);
}

size_t cube_build_sample(
    uint8_t *out, size_t capacity, const cube_sample *sample, const uint32_t *frequency,
    const uint32_t *pad_fault, const int16_t *temperature) {
    size_t n_cubes = sample->n_cubes;
    size_t payload = CUBE_SAMPLE_SIZE(sample->n_cubes, sample->n_pads);
    uint8_t *at = open_frame(out, capacity, CUBE_SAMPLE, payload);
    if (at == NULL)
        return 0;
    at = store_u32(at, sample->sequence);
    at = store_u16(at, sample->first_cube);
    at = store_u16(at, sample->n_cubes);
    at = store_u64(at, sample->device_us);
    at = store_u32(at, sample->n_pads); /* and three spare bytes */
    for (size_t i = 0; i < n_cubes * sample->n_pads; i++)
        at = store_u32(at, frequency[i]);
    for (size_t i = 0; i < n_cubes; i++)
        at = store_u32(at, pad_fault == NULL ? 0 : pad_fault[i]);
    for (size_t i = 0; i < n_cubes; i++)
        at = store_u16(
            at, (uint16_t)(temperature == NULL ? CUBE_TEMPERATURE_UNKNOWN : temperature[i]));
    return close_frame(out, at, payload);
}

size_t cube_build_stats(uint8_t *out, size_t capacity, const cube_stats *stats) {
    uint8_t *at = open_frame(out, capacity, CUBE_STATS, CUBE_STATS_SIZE);
    if (at == NULL)
        return 0;
    at = store_u64(at, stats->uptime_ms);
    at = store_u32(at, stats->taken);
    at = store_u32(at, stats->dropped);
    at = store_u16(at, stats->supply_mv);
    return close_frame(out, at, CUBE_STATS_SIZE);
}

size_t cube_build_time(uint8_t *out, size_t capacity, const cube_time *time) {
    uint8_t *at = open_frame(out, capacity, CUBE_TIME, CUBE_TIME_SIZE);
    if (at == NULL)
        return 0;
    at = store_u32(at, time->number);
    at = store_u64(at, time->device_us);
    return close_frame(out, at, CUBE_TIME_SIZE);
}

size_t cube_build_request(uint8_t *out, size_t capacity, const cube_request *request) {
    uint8_t *at = open_frame(out, capacity, CUBE_REQUEST, CUBE_REQUEST_SIZE);
    if (at == NULL)
        return 0;
    at = store_u8(at, request->request);
    at = store_u32(at, request->argument);
    return close_frame(out, at, CUBE_REQUEST_SIZE);
}

size_t cube_build_ack(uint8_t *out, size_t capacity, const cube_ack *ack) {
    uint8_t *at = open_frame(out, capacity, CUBE_ACK, CUBE_ACK_SIZE);
    if (at == NULL)
        return 0;
    at = store_u8(at, ack->request);
    at = store_u8(at, ack->result);
    at = store_u32(at, ack->argument);
    return close_frame(out, at, CUBE_ACK_SIZE);
}

size_t cube_cubes_per_frame(size_t wire, size_t n_pads) {
    size_t payload = wire < CUBE_MAX_PAYLOAD ? wire : CUBE_MAX_PAYLOAD;
    while (payload > 0 && CUBE_WIRE_SIZE(payload) > wire)
        payload--;
    if (payload < CUBE_SAMPLE_SIZE(0, 0))
        return 0;
    return (payload - CUBE_SAMPLE_SIZE(0, 0)) / CUBE_SAMPLE_ROW(n_pads);
}
