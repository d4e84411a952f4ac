// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* MPS2 with the image AN386: Cortex-M4, 25 MHz. QEMU runs it as mps2-an386.
 * Registers: ARM, Cortex-M System Design Kit, technical reference manual. */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

#define BOARD_HZ 25000000u

struct uart { /* CMSDK APB UART */
    volatile uint32_t data;
    volatile uint32_t state;
    volatile uint32_t control;
    volatile uint32_t interrupt; /* write 1 to clear */
    volatile uint32_t divider;   /* at least 16 */
};
#define UART_TX_FULL 1u /* state */
#define UART_RX_FULL 2u
#define UART_TX 1u      /* control: enables, with their interrupts */
#define UART_RX 2u
#define UART_TX_INTERRUPT 4u
#define UART_RX_INTERRUPT 8u
#define UART_TX_CLEAR 1u /* interrupt */
#define UART_RX_CLEAR 2u

struct timer { /* CMSDK APB timer; counts down */
    volatile uint32_t control;
    volatile uint32_t value;
    volatile uint32_t reload;
    volatile uint32_t interrupt;
};

struct systick {
    volatile uint32_t control;
    volatile uint32_t reload;
    volatile uint32_t value;
};
#define SYSTICK_ON 7u /* processor clock, interrupt, enabled */

#define TIMER0 ((struct timer *)0x40000000u)
#define UART0 ((struct uart *)0x40004000u)
#define UART1 ((struct uart *)0x40005000u)
#define SYSTICK ((struct systick *)0xE000E010u)
#define INTERRUPT_ENABLE (*(volatile uint32_t *)0xE000E100u)

enum interrupt { UART0_RX = 0, UART0_TX = 1, UART1_RX = 2, UART1_TX = 3 };

static inline void interrupts_off(void) {
    __asm volatile("cpsid i" ::: "memory");
}

static inline void interrupts_on(void) {
    __asm volatile("cpsie i" ::: "memory");
}

static inline void wait_for_interrupt(void) {
    __asm volatile("wfi" ::: "memory");
}

#endif
