// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Windows and captures of a board without oscillators.
 *
 * What timers would capture comes over UART1: the hub asks for each window, and whoever plays the
 * oscillators (cube_tensor_hub/captures.py) answers with the edges that the counter
 * would have seen. On a board with pads, a file that reads its timers takes the place of this one.
 *
 *     question   number u32, middle of the window in us u64, CRC-32 u32
 *     answer     number u32, for each pad {first, last, periods: u16}, CRC-32 u32
 *
 * first, last: ticks of the counter since the window began. All numbers are little-endian. */
#include <string.h>

#include "cube_wire.h"
#include "port.h"
#include "serial.h"
#include "size.h"

#define ANSWER_US 2000000u /* whoever plays the oscillators does not answer: ask again */
#define QUESTION_SIZE 16u
#define EDGES_SIZE 6u
#define ANSWER_SIZE (4u + N_PADS * EDGES_SIZE + 4u)

static struct {
    uint32_t number; /* of the window */
    uint64_t begin_us;
    uint32_t received; /* bytes of the answer */
    uint32_t crc;
    uint8_t field[EDGES_SIZE]; /* the last number, or edges, or CRC of the answer */
    struct capture captures[N_PADS];
} pads;

uint32_t port_counter_hz(struct port *port) {
    (void)port;
    return BOARD_HZ;
}

static uint64_t middle_us(void) {
    return pads.begin_us + WINDOW_US / 2;
}

void port_begin_window(struct port *port) {
    pads.begin_us = port_now_us(port);
    pads.number++;
    pads.received = 0;
    pads.crc = 0;
    uint8_t byte;
    while (ring_get(&serial_pads.in, &byte)) {
        /* an answer that came too late */
    }
    uint8_t question[QUESTION_SIZE];
    uint64_t middle = middle_us();
    memcpy(question, &pads.number, 4); /* little-endian, like the processor */
    memcpy(question + 4, &middle, 8);
    uint32_t crc = cube_crc32(0, question, 12);
    memcpy(question + 12, &crc, 4);
    serial_send(&serial_pads, question, sizeof question);
}

/* The byte at this place of the answer. */
static void take(uint32_t at, uint8_t byte) {
    pads.field[at < 4 ? at : (at - 4) % EDGES_SIZE] = byte;
    if (at < ANSWER_SIZE - 4)
        pads.crc = cube_crc32(pads.crc, &byte, 1);
    if (at < 4 || at >= ANSWER_SIZE - 4 || (at - 4) % EDGES_SIZE != EDGES_SIZE - 1)
        return;
    uint16_t edges[3];
    memcpy(edges, pads.field, sizeof edges);
    pads.captures[(at - 4) / EDGES_SIZE] =
        (struct capture){.first = edges[0], .last = edges[1], .periods = edges[2]};
}

const struct capture *port_window(struct port *port, uint64_t *middle) {
    uint8_t byte;
    while (pads.received < ANSWER_SIZE && ring_get(&serial_pads.in, &byte)) {
        take(pads.received++, byte);
        if (pads.received == 4 && memcmp(pads.field, &pads.number, 4) != 0)
            pads.received = 0; /* an answer to another question: what follows has no right CRC */
    }
    bool is_whole = pads.received == ANSWER_SIZE && memcmp(pads.field, &pads.crc, 4) == 0;
    uint64_t lasts_us = port_now_us(port) - pads.begin_us;
    if (!is_whole && lasts_us > ANSWER_US)
        port_begin_window(port);
    if (!is_whole || lasts_us < WINDOW_US)
        return NULL;
    *middle = middle_us();
    return pads.captures;
}
