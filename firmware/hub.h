// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* A hub of docs/protocol.md: answers requests, takes samples, drops what finds no room.
 *
 * It has no heap, no clock and no I/O of its own: port.h has those. A program makes a hub and calls
 * hub_step() again and again, from its main loop only:
 *
 *     hub_begin(&hub, &config, &port);
 *     for (;;) {
 *         hub_step(&hub);
 *         sleep until something happens;
 *     }
 */
#ifndef HUB_H
#define HUB_H

#include "cube_wire.h"
#include "port.h"

#define HUB_FIRMWARE 0x00010000u
#define HUB_MAX_REQUEST CUBE_DECODER_SIZE(CUBE_REQUEST_SIZE)

/* What a hub is. All pointers stay valid for as long as the hub is used. */
struct hub_config {
    uint64_t uid;
    const uint64_t *cube_uids; /* n_cubes */
    uint16_t n_cubes;
    uint8_t n_pads;            /* of each cube, 1 to 32 */
    uint16_t cubes_per_frame;  /* a sample of more cubes takes several frames */
    uint32_t period_us;        /* sample period after power-up */
    uint32_t min_period_us;    /* longer than a window */
    uint32_t max_period_us;
    uint32_t *frequency;       /* memory of n_cubes x n_pads */
    uint8_t *frame;            /* memory of frame_size bytes: of the longest frame on the wire */
    size_t frame_size;
};

struct hub {
    const struct hub_config *config;
    struct port *port;
    uint32_t period_us;
    bool started;
    bool measuring;      /* a window is under way */
    uint64_t next_us;    /* when the next window begins */
    uint64_t second_us;  /* when HELLO and STATS are due */
    uint32_t taken;      /* samples, since power-up; the number of the next one */
    uint32_t dropped;
    cube_sample sample;  /* the last one; its cubes before first_cube are sent */
    bool sending;        /* the last sample has cubes that are not sent */
    cube_decoder decoder;
    uint8_t request[HUB_MAX_REQUEST];
    uint8_t unread[32];  /* bytes from the host that are not decoded yet */
    size_t unread_at, unread_end;
};

/* Power-up: stopped, HELLO is due. false: the frame buffer is too small for a frame of
 * cubes_per_frame cubes or for HELLO, or cubes_per_frame or a period is 0. */
bool hub_begin(struct hub *, const struct hub_config *, struct port *);

/* Does all that is to be done now. Returns when something is to be done next, device time in us,
 * unless bytes come or a window ends before that. */
uint64_t hub_step(struct hub *);

/* Frequency of a pad in mHz by reciprocal counting: whole periods over the time between their first
 * and last edge. Both edges are known to one tick of the counter, so the relative error is below
 * 1 / (last - first), at any frequency. 0: not measured, or too fast for the wire. */
uint32_t hub_frequency(const struct capture *, uint32_t counter_hz);

#endif
