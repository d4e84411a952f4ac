// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Coverage-guided fuzzing of native/cube_wire.c, by hand:
 *
 *     clang -g -O1 -fsanitize=fuzzer,address,undefined -Inative native/cube_wire.c \
 *         test/fuzz_wire.c -o /tmp/fuzz_wire && /tmp/fuzz_wire -max_total_time=60
 *
 * It feeds any bytes, and frames with a right checksum around any payload, whole and cut, to
 * decoders with buffers of any size. No byte beyond a buffer is touched, however the stream is cut
 * the counters are the same, and each run is counted once. */
#include "cube_wire.h"

#include <stdlib.h>
#include <string.h>

static cube_counters feed(
    const uint8_t *data, size_t size, size_t step, size_t capacity, uint64_t *digest) {
    uint8_t *buffer = malloc(capacity);
    cube_decoder decoder;
    if (!cube_decoder_init(&decoder, buffer, capacity))
        abort();
    *digest = 0;
    while (size > 0) {
        size_t n = step < size ? step : size;
        uint8_t *part = malloc(n); /* exactly: sanitizers see what lies beyond */
        memcpy(part, data, n);
        data += n;
        size -= n;
        for (size_t at = 0; at < n;) {
            cube_frame frame;
            at += cube_decode(&decoder, part + at, n - at, &frame);
            if (frame.type == CUBE_NO_FRAME)
                continue;
            *digest = *digest * 31 + cube_crc32(0, frame.raw, frame.size - CUBE_CRC);
            if (frame.type == CUBE_HELLO)
                for (size_t i = 0; i < frame.as.hello.n_cubes; i++)
                    *digest += cube_uid(&frame, i);
            if (frame.type == CUBE_SAMPLE)
                for (size_t i = 0; i < frame.as.sample.n_cubes; i++) {
                    *digest += cube_pad_fault(&frame, i) ^ (uint16_t)cube_temperature(&frame, i);
                    for (size_t pad = 0; pad < frame.as.sample.n_pads; pad++)
                        *digest += cube_frequency(&frame, i, pad);
                }
        }
        free(part);
    }
    free(buffer);
    return decoder.counters;
}

/* A right checksum around the bytes; returns their length on the wire. */
static size_t wrap(const uint8_t *data, size_t size, uint8_t *out) {
    static const uint8_t types[] = {1, 2, 3, 4, 0x10, 0x11, 5};
    uint8_t *raw = malloc(size + 8);
    raw[0] = size ? types[data[0] % sizeof types] : CUBE_SAMPLE;
    raw[1] = CUBE_VERSION;
    raw[2] = (uint8_t)(size & 0xFF);
    raw[3] = (uint8_t)(size >> 8);
    memcpy(raw + 4, data, size);
    uint32_t crc = cube_crc32(0, raw, size + 4);
    for (int i = 0; i < 4; i++)
        raw[size + 4 + (size_t)i] = (uint8_t)(crc >> 8 * i);
    out[0] = 0;
    size_t length = cube_cobs_encode(raw, size + 8, out + 1);
    out[length + 1] = 0;
    free(raw);
    return length + 2;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    if (size < 4)
        return 0;
    size_t step = 1 + data[0], capacity = CUBE_DECODER_SIZE(data[1] < 128 ? 5u + data[1] : 65535u);
    uint8_t mode = data[2] % 2;
    data += 3, size -= 3;
    uint8_t *stream = malloc(CUBE_WIRE_SIZE(size) + 2 * size + 1);
    size_t length = size;
    if (mode)
        length = wrap(data, size, stream);
    else
        memcpy(stream, data, size);
    stream[length++] = 0;
    size_t runs = 0;
    for (size_t i = 1; i < length; i++)
        runs += stream[i] == 0 && stream[i - 1] != 0;
    uint64_t whole_digest, cut_digest;
    cube_counters whole = feed(stream, length, length, capacity, &whole_digest);
    cube_counters cut = feed(stream, length, step, capacity, &cut_digest);
    free(stream);
    if (memcmp(&whole, &cut, sizeof whole) != 0 || whole_digest != cut_digest)
        abort();
    if (whole.bytes != length || whole.frames + whole.crc + whole.framing + whole.length +
                                         whole.version + whole.unknown_type + whole.overrun !=
                                     runs)
        abort();
    return 0;
}
