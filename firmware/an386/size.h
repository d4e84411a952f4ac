// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* What the hub carries, and how long it counts. */
#ifndef SIZE_H
#define SIZE_H

#ifndef HUB_CUBES
#define HUB_CUBES 4u
#endif
#ifndef HUB_PADS
#define HUB_PADS 8u
#endif
#define N_PADS (HUB_CUBES * HUB_PADS)
#define WINDOW_US 2500u /* resolves 1 / (25 MHz * 2.5 ms) = 16 ppm; 62500 ticks */

#endif
