// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* A UART with a ring in each direction, moved by interrupts. */
#ifndef SERIAL_H
#define SERIAL_H

#include "board.h"
#include "ring.h"

struct serial {
    struct uart *uart;
    struct ring in, out;
};

extern struct serial serial_host; /* UART0: the protocol */
extern struct serial serial_pads; /* UART1: captures of the oscillators */

void serial_begin(void);

/* Takes all of the bytes or none: false. */
bool serial_send(struct serial *, const uint8_t *data, size_t size);

/* Interrupts. */
void serial_host_rx(void);
void serial_host_tx(void);
void serial_pads_rx(void);
void serial_pads_tx(void);

#endif
