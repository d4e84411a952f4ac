// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Lets test_native_wire.py drive the C wire: commands come on standard input, answers go out.
 *
 * A command is a letter, a u32 and so many bytes:
 *     N capacity   a new decoder with a buffer of this size; answers whether it is large enough
 *     D size data  decode; answers each frame, then the counters
 *     R            the stream ended; answers the counters
 *     E size data  COBS there and back, and CRC-32; answers the code and the CRC
 * Every buffer has exactly the size that the contract asks for: sanitizers see each byte beyond. */
#include "cube_wire.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void give(const void *data, size_t size) {
    fwrite(data, 1, size, stdout);
}

static void give_block(const void *data, size_t size) {
    uint32_t length = (uint32_t)size;
    give(&length, sizeof length);
    give(data, size);
}

static void fail(const char *why) {
    fprintf(stderr, "%s\n", why);
    exit(1);
}

/* The frame built again from its fields. */
static size_t build(const cube_frame *frame, uint8_t *out, size_t capacity) {
    if (frame->type == CUBE_HELLO) {
        size_t n_cubes = frame->as.hello.n_cubes;
        uint64_t *uids = malloc(n_cubes * sizeof *uids + 1);
        for (size_t i = 0; i < n_cubes; i++)
            uids[i] = cube_uid(frame, i);
        size_t size = cube_build_hello(out, capacity, &frame->as.hello, uids);
        free(uids);
        return size;
    }
    if (frame->type == CUBE_SAMPLE) {
        size_t n_cubes = frame->as.sample.n_cubes, n_pads = frame->as.sample.n_pads;
        uint32_t *frequency = malloc(n_cubes * n_pads * sizeof *frequency + 1);
        uint32_t *fault = malloc(n_cubes * sizeof *fault + 1);
        int16_t *temperature = malloc(n_cubes * sizeof *temperature + 1);
        for (size_t i = 0; i < n_cubes; i++) {
            for (size_t pad = 0; pad < n_pads; pad++)
                frequency[i * n_pads + pad] = cube_frequency(frame, i, pad);
            fault[i] = cube_pad_fault(frame, i);
            temperature[i] = cube_temperature(frame, i);
        }
        size_t size =
            cube_build_sample(out, capacity, &frame->as.sample, frequency, fault, temperature);
        free(frequency), free(fault), free(temperature);
        return size;
    }
    if (frame->type == CUBE_STATS)
        return cube_build_stats(out, capacity, &frame->as.stats);
    if (frame->type == CUBE_TIME)
        return cube_build_time(out, capacity, &frame->as.time);
    if (frame->type == CUBE_REQUEST)
        return cube_build_request(out, capacity, &frame->as.request);
    return cube_build_ack(out, capacity, &frame->as.ack);
}

static void give_frame(const cube_frame *frame) {
    size_t capacity = CUBE_WIRE_SIZE(frame->size - CUBE_HEADER - CUBE_CRC);
    uint8_t *out = malloc(capacity);
    if (build(frame, out, capacity - 1) != 0)
        fail("a frame was written where it does not fit");
    size_t size = build(frame, out, capacity);
    give("F", 1);
    give_block(frame->raw, frame->size);
    give_block(out, size);
    free(out);
}

static void decode(cube_decoder *decoder, const uint8_t *data, size_t size) {
    cube_frame frame;
    while (size > 0) {
        size_t taken = cube_decode(decoder, data, size, &frame);
        if (frame.type != CUBE_NO_FRAME)
            give_frame(&frame);
        data += taken;
        size -= taken;
    }
}

static void give_counters(const cube_decoder *decoder) {
    int64_t other = decoder->other_version;
    give("C", 1);
    give(&decoder->counters, sizeof decoder->counters);
    give(&other, sizeof other);
    fflush(stdout);
}

static void encode(const uint8_t *data, size_t size) {
    size_t most = CUBE_COBS_SIZE(size);
    uint8_t *room = malloc(CUBE_GAP + most);
    size_t length = cube_cobs_encode(data, size, room + CUBE_GAP);
    uint32_t crc = cube_crc32(cube_crc32(0, data, size / 3), data + size / 3, size - size / 3);
    give_block(room + CUBE_GAP, length);
    give(&crc, sizeof crc);
    if (cube_cobs_decode(room + CUBE_GAP, length, room) != size || memcmp(room, data, size) != 0)
        fail("COBS does not come back");
    fflush(stdout);
    free(room);
}

int main(void) {
    cube_decoder decoder;
    uint8_t *buffer = NULL;
    char command;
    uint32_t size;
    while (fread(&command, 1, 1, stdin) == 1 && fread(&size, sizeof size, 1, stdin) == 1) {
        if (command == 'N') {
            free(buffer);
            buffer = malloc(size + !size);
            uint8_t done = cube_decoder_init(&decoder, buffer, size);
            give(&done, 1);
            fflush(stdout);
        } else if (command == 'R') {
            cube_decoder_reset(&decoder);
            give_counters(&decoder);
        } else {
            uint8_t *data = malloc(size + !size);
            if (fread(data, 1, size, stdin) != size)
                fail("cut off");
            if (command == 'D') {
                decode(&decoder, data, size);
                give_counters(&decoder);
            } else {
                encode(data, size);
            }
            free(data);
        }
    }
    free(buffer);
    return 0;
}
