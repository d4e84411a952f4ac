// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* See serial.h. */
#include "serial.h"

#define BAUD 921600u
#define RING(array) {.bytes = (array), .size = sizeof(array)}

static uint8_t host_in[128], host_out[1024], pads_in[256], pads_out[32];

struct serial serial_host = {UART0, RING(host_in), RING(host_out)};
struct serial serial_pads = {UART1, RING(pads_in), RING(pads_out)};

static void begin(struct uart *uart) {
    uart->divider = BOARD_HZ / BAUD;
    uart->control = UART_TX | UART_RX | UART_TX_INTERRUPT | UART_RX_INTERRUPT;
}

void serial_begin(void) {
    begin(serial_host.uart);
    begin(serial_pads.uart);
    INTERRUPT_ENABLE = 1u << UART0_RX | 1u << UART0_TX | 1u << UART1_RX | 1u << UART1_TX;
}

/* Gives the UART what it takes; the interrupt goes on from there. */
static void pump(struct serial *serial) {
    uint8_t byte;
    while (!(serial->uart->state & UART_TX_FULL) && ring_get(&serial->out, &byte))
        serial->uart->data = byte;
}

bool serial_send(struct serial *serial, const uint8_t *data, size_t size) {
    if (ring_room(&serial->out) < size)
        return false;
    for (size_t i = 0; i < size; i++)
        ring_put(&serial->out, data[i]);
    interrupts_off(); /* `pump` is a reader of the ring, and so is the interrupt */
    pump(serial);
    interrupts_on();
    return true;
}

static void received(struct serial *serial) {
    serial->uart->interrupt = UART_RX_CLEAR;
    while (serial->uart->state & UART_RX_FULL) {
        /* What finds no room is lost: the host asks again. */
        ring_put(&serial->in, (uint8_t)serial->uart->data);
    }
}

static void sent(struct serial *serial) {
    serial->uart->interrupt = UART_TX_CLEAR;
    pump(serial);
}

void serial_host_rx(void) {
    received(&serial_host);
}

void serial_host_tx(void) {
    sent(&serial_host);
}

void serial_pads_rx(void) {
    received(&serial_pads);
}

void serial_pads_tx(void) {
    sent(&serial_pads);
}
