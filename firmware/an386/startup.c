// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Vectors, and what C expects before main. */
#include <stdint.h>

#include "serial.h"

extern uint32_t stack_end, data_load, data_begin, data_end, bss_begin, bss_end;
int main(void);
void reset(void);

/* A fault: the host sees that the hub is silent, a debugger sees where. */
static void halt(void) {
    for (;;) {
    }
}

void reset(void) {
    const uint32_t *from = &data_load;
    for (uint32_t *to = &data_begin; to < &data_end; to++)
        *to = *from++;
    for (uint32_t *to = &bss_begin; to < &bss_end; to++)
        *to = 0;
    main();
    halt();
}

/* Its interrupt does nothing but wake the processor. */
static void tick(void) {
}

typedef void (*handler)(void);

__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    handler system[15];
    handler uart[4];
} vectors = {
    .stack = &stack_end,
    .system = {reset, halt, halt, halt, halt, halt, 0, 0, 0, 0, halt, halt, 0, halt, tick},
    .uart = {serial_host_rx, serial_host_tx, serial_pads_rx, serial_pads_tx},
};
