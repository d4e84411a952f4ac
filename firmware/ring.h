// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Bytes from one writer to one reader, of which either may be an interrupt. Nothing is locked: each
 * side changes its own index only, after the bytes are in place. */
#ifndef RING_H
#define RING_H

#include <stdatomic.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct ring {
    uint8_t *bytes;
    size_t size; /* a power of two */
    atomic_size_t written, read; /* so far; they wrap */
};

static inline size_t ring_used(const struct ring *ring) {
    return atomic_load_explicit(&ring->written, memory_order_acquire) -
           atomic_load_explicit(&ring->read, memory_order_acquire);
}

static inline size_t ring_room(const struct ring *ring) {
    return ring->size - ring_used(ring);
}

/* false: it is full. */
static inline bool ring_put(struct ring *ring, uint8_t byte) {
    size_t written = atomic_load_explicit(&ring->written, memory_order_relaxed);
    if (ring_room(ring) == 0)
        return false;
    ring->bytes[written & (ring->size - 1)] = byte;
    atomic_store_explicit(&ring->written, written + 1, memory_order_release);
    return true;
}

/* false: it is empty. */
static inline bool ring_get(struct ring *ring, uint8_t *byte) {
    size_t read = atomic_load_explicit(&ring->read, memory_order_relaxed);
    if (ring_used(ring) == 0)
        return false;
    *byte = ring->bytes[read & (ring->size - 1)];
    atomic_store_explicit(&ring->read, read + 1, memory_order_release);
    return true;
}

#endif
