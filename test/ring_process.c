// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Two threads and a ring between them: every byte arrives, once and in order. */
#include <pthread.h>
#include <stdio.h>

#include "ring.h"

#define BYTES 5000u

static uint8_t memory[64];
static struct ring ring = {.bytes = memory, .size = sizeof memory};

static uint8_t value(uint32_t at) {
    return (uint8_t)(at * 2654435761u >> 24);
}

static void *write_all(void *unused) {
    for (uint32_t at = 0; at < BYTES;)
        at += ring_put(&ring, value(at));
    return unused;
}

int main(void) {
    pthread_t writer;
    if (pthread_create(&writer, NULL, write_all, NULL) != 0)
        return 2;
    for (uint32_t at = 0; at < BYTES;) {
        uint8_t byte;
        if (!ring_get(&ring, &byte))
            continue;
        if (byte != value(at)) {
            printf("byte %u is %u, not %u\n", at, byte, value(at));
            return 1;
        }
        at++;
    }
    pthread_join(writer, NULL);
    return ring_used(&ring) == 0 ? 0 : 1;
}
