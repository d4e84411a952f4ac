// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* A hub on MPS2-AN386, which QEMU emulates.
 *
 * captures.c, which stands in for the timers of a board with pads, has the rest of the port. */
#include "board.h"
#include "hub.h"
#include "serial.h"
#include "size.h"

#ifndef HUB_UID
#define HUB_UID 0x4E386u /* this board has no number of its own */
#endif

/* Half a kilobyte of frame: a sample of many pads takes several. */
#define CUBES_THAT_FIT ((512u - CUBE_SAMPLE_SIZE(0u, 0u)) / CUBE_SAMPLE_ROW(HUB_PADS))
#define CUBES_PER_FRAME (HUB_CUBES < CUBES_THAT_FIT ? HUB_CUBES : CUBES_THAT_FIT)
#define SAMPLE_WIRE CUBE_WIRE_SIZE(CUBE_SAMPLE_SIZE(CUBES_PER_FRAME, HUB_PADS))
#define HELLO_WIRE CUBE_WIRE_SIZE(CUBE_HELLO_SIZE(HUB_CUBES))
#define FRAME_SIZE (SAMPLE_WIRE > HELLO_WIRE ? SAMPLE_WIRE : HELLO_WIRE)

struct port {
    uint64_t ticks; /* of TIMER0 since power-up */
    uint32_t last_value;
};

static struct port board;
static struct hub the_hub;
static uint64_t cube_uids[HUB_CUBES];
static uint32_t frequency[N_PADS];
static uint8_t frame[FRAME_SIZE];

int main(void) {
    TIMER0->reload = UINT32_MAX;
    TIMER0->value = board.last_value = UINT32_MAX;
    TIMER0->control = 1;
    SYSTICK->reload = BOARD_HZ / 1000 - 1;
    SYSTICK->value = 0;
    SYSTICK->control = SYSTICK_ON;
    serial_begin();
    for (uint32_t cube = 0; cube < HUB_CUBES; cube++)
        cube_uids[cube] = (uint64_t)HUB_UID << 16 | (cube + 1);
    const struct hub_config config = {
        .uid = HUB_UID,
        .cube_uids = cube_uids,
        .n_cubes = HUB_CUBES,
        .n_pads = HUB_PADS,
        .cubes_per_frame = CUBES_PER_FRAME,
        .period_us = 20000,
        .min_period_us = WINDOW_US + 2000u,
        .max_period_us = 10000000,
        .frequency = frequency,
        .frame = frame,
        .frame_size = sizeof frame,
    };
    if (!hub_begin(&the_hub, &config, &board))
        return 1;
    for (;;) {
        hub_step(&the_hub);
        wait_for_interrupt(); /* at most until the next tick, 1 ms */
    }
}

/* ----------------------------------------------------------------------------------- port ---- */

uint64_t port_now_us(struct port *port) {
    uint32_t value = TIMER0->value;
    port->ticks += port->last_value - value; /* counts down, and wraps after 171 s */
    port->last_value = value;
    return port->ticks / (BOARD_HZ / 1000000u);
}

size_t port_room(struct port *port) {
    (void)port;
    return ring_room(&serial_host.out);
}

void port_send(struct port *port, const uint8_t *data, size_t size) {
    (void)port;
    serial_send(&serial_host, data, size);
}

size_t port_receive(struct port *port, uint8_t *data, size_t size) {
    (void)port;
    size_t n = 0;
    while (n < size && ring_get(&serial_host.in, &data[n]))
        n++;
    return n;
}

void port_identify(struct port *port, uint32_t seconds) {
    (void)port;
    (void)seconds; /* the board's LEDs are not visible in the emulator */
}

uint16_t port_supply_mv(struct port *port) {
    (void)port;
    return 0;
}
