// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* What a hub needs of the board it runs on. hub.c calls it; every port defines struct port.
 *
 * None of these functions waits. Interrupts may run at any time beside them.
 */
#ifndef PORT_H
#define PORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct port;

/* What reciprocal counting needs of one pad: the counter at the first and at the last edge within
 * the window, and the periods between these two. periods 0: the pad does not oscillate. */
struct capture {
    uint32_t first;
    uint32_t last;
    uint32_t periods;
};

/* Microseconds since power-up, from a counter that nothing stops: ticks of an interrupt are lost
 * under load. */
uint64_t port_now_us(struct port *);

/* Bytes to the host. `room`: how many the port takes now. Those that it took go out by themselves,
 * in order. */
size_t port_room(struct port *);
void port_send(struct port *, const uint8_t *data, size_t size);

/* Bytes from the host: at most `size`, 0 if there are none. */
size_t port_receive(struct port *, uint8_t *data, size_t size);

/* Begins a window over all pads; one that is under way is given up. */
void port_begin_window(struct port *);

/* The captures of the window, all pads of the first cube, then of the next; NULL while it lasts.
 * They stay until a window begins. middle_us: device time of the middle of the window. */
const struct capture *port_window(struct port *, uint64_t *middle_us);

/* Frequency of the counter of the captures. */
uint32_t port_counter_hz(struct port *);

/* For people: shows which hub this is, for so many seconds. */
void port_identify(struct port *, uint32_t seconds);

/* Supply voltage in mV, 0 if the board cannot measure it. */
uint16_t port_supply_mv(struct port *);

#endif
