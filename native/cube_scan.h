// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* The rows of a scan: from frequencies of pads to stress, status and the sums of health windows.
 *
 * One row is one sample of one cube, one scan at most one row of each cube. The readable
 * specification in numpy is cube_tensor_driver/core/kernel/rows.py; tests hold both equal to the bit.
 *
 * The same bits on every processor: each operation is one of + - * / sqrt in float, which IEEE 754
 * rounds correctly; the terms of a sum are added in a fixed order; and the file is compiled with
 * -ffp-contract=off, so that no product and sum are rounded together. Vector instructions compute
 * several pads, or several outputs of one row, side by side, which changes no order.
 *
 * Memory of a scan of 1264 planar cubes (8 pads): state of health 0.62 MB, pad law 0.08 MB,
 * frequencies and results 0.15 MB, and a matrix of 0.5 kB for each calibration (0.65 MB if all
 * differ): 0.9 to 1.5 MB, which are to stay in the L2 cache. Each byte is used once per scan, in the
 * order of the rows. A block of rows (v, outputs, ratios) takes at most 22 kB of the L1 cache.
 *
 * No heap, no system, no state of its own. */
#ifndef CUBE_SCAN_H
#define CUBE_SCAN_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define CUBE_SCAN_MAX_PADS 32    /* pads of a cube; bit p of a mask stands for pad p */
#define CUBE_SCAN_BLOCK 16       /* outputs computed side by side; matrices are padded to it */
#define CUBE_SCAN_MAX_OUTPUTS 48 /* 15 components and at most 32 residuals, padded */
#define CUBE_SCAN_COMPONENTS 15
#define CUBE_SCAN_STRESS 6

/* Requests of `cube_scan` to its caller. Any other value is the key of a missing table, which the
 * caller must add (see `keys`). */
#define CUBE_SCAN_DONE (-1)
#define CUBE_SCAN_WINDOW (-2)       /* the next scan lies outside the window of health */
#define CUBE_SCAN_CONDITION (-3)    /* a pad of this row has a condition that is not found yet */
#define CUBE_SCAN_UNKNOWN_CUBE (-4) /* the row is of no cube of the skin */
#define CUBE_SCAN_STEP (-5)         /* the next scan lies outside the step of compensation */

/* State of the health of one cube: CUBE_STATE in core/kernel/contract.py. */
typedef struct {
    int64_t time_ns, interval_ns;    /* newest time stamp, and its distance from the one before */
    int64_t gap_before, gap_within;  /* of the window, in ns */
    int64_t rows, over_limit;        /* of the window */
    uint32_t mask, found;            /* pads not used; pads with a condition in this window */
    float temperature;               /* newest, in degrees Celsius */
    uint16_t status, is_doubtful;    /* conditions of all pads; whether time_ns is doubtful */
} cube_state;

/* Arrays of a call: type, name, kind (of numpy), shape, use. core/kernel/contract.py describes them.
 * Letters of a shape: N rows, C cubes, P pads, G calibrations, D degrees, T tables, E extra tables,
 * K outputs, M instants; digits stand for themselves, Q for the 12 quantities. */
#define CUBE_SCAN_ARRAYS(X)                           \
    X(const int32_t, calibration, 'i', "C", INPUT)    \
    X(const int32_t, pads, 'i', "G", INPUT)           \
    X(const float, rest, 'f', "CP", INPUT)            \
    X(const float, highest, 'f', "CP", INPUT)         \
    X(const double, reference, 'f', "G", INPUT)       \
    X(const double, coefficients, 'f', "GDP", INPUT)  \
    X(const float, matrix, 'f', "TPK", INPUT)         \
    X(const float, limit, 'f', "T", INPUT)            \
    X(const uint16_t, observed, 'u', "T", INPUT)      \
    X(const int64_t, keys, 'i', "E", INPUT)           \
    X(const int32_t, numbers, 'i', "E", INPUT)        \
    X(int64_t, words, 'i', "C8", STATE)               \
    X(float, quantities, 'f', "QCP", STATE)           \
    X(int64_t, window_ns, 'i', "3", STATE)            \
    X(const int64_t, step_ns, 'i', "2", OPTION)       \
    X(const int64_t, since_ns, 'i', "C", OPTION)      \
    X(const float, offset, 'f', "CP", OPTION)         \
    X(const float, slope, 'f', "CP", OPTION)          \
    X(const float, gain, 'f', "CP", OPTION)           \
    X(const uint16_t, lasting, 'u', "C", OPTION)      \
    X(const float, response, 'f', "C3P", OPTION)      \
    X(const uint16_t, weighing, 'u', "C", OPTION)     \
    X(int64_t, newest_ns, 'i', "C", STATE)            \
    X(float, reading, 'f', "CP", STATE)               \
    X(float, subtracted, 'f', "CP", STATE)            \
    X(float, newest_force, 'f', "C3", STATE)          \
    X(const uint16_t, cube, 'u', "N", INPUT)          \
    X(const float, frequency, 'f', "NP", INPUT)       \
    X(const float, temperature, 'f', "N", INPUT)      \
    X(const uint32_t, pad_fault, 'u', "N", INPUT)     \
    X(const int64_t, stamp_ns, 'i', "N", INPUT)       \
    X(const uint16_t, doubt, 'u', "N", INPUT)         \
    X(const bool, known, 'b', "N", OPTION)            \
    X(const float, force, 'f', "N3", OPTION)          \
    X(float, stress, 'f', "N6", RESULT)               \
    X(float, gradient, 'f', "N9", RESULT)             \
    X(float, residual, 'f', "N", RESULT)              \
    X(uint16_t, status, 'u', "N", RESULT)             \
    X(uint16_t, row_observed, 'u', "N", RESULT)       \
    X(uint32_t, left_out, 'u', "N", RESULT)          \
    X(float, row_offset, 'f', "NP", STATE)

/* Use of an array: INPUT and OPTION are read, STATE is read and written, RESULT is written. OPTION and
 * STATE may be absent. */
enum cube_scan_use { CUBE_SCAN_INPUT, CUBE_SCAN_OPTION, CUBE_SCAN_STATE, CUBE_SCAN_RESULT };
#define CUBE_SCAN_LETTERS "NCPGDTEKQMRVOJ"

typedef struct {
#define CUBE_SCAN_FIELD(type, name, kind, shape, use) type *name;
    CUBE_SCAN_ARRAYS(CUBE_SCAN_FIELD)
    int64_t length[sizeof CUBE_SCAN_LETTERS]; /* length of each axis, indexed by its letter */
    int64_t n_residuals; /* outputs 15 to 15 + n_residuals - 1 are residuals */
} cube_scan_call;

typedef struct {
    const char *name, *shape;
    size_t offset, size;
    char kind;
    enum cube_scan_use use;
} cube_scan_array;

#define CUBE_SCAN_N_ARRAYS 41
extern const cube_scan_array cube_scan_arrays[CUBE_SCAN_N_ARRAYS];

/* Returns a call without arrays. The caller sets the arrays (`cube_scan_set`) and n_residuals. */
cube_scan_call cube_scan_begin(void);

/* Stores the address of an array in a call, and its shape in the lengths of the call. Returns false if
 * its lengths contradict those of other arrays. */
bool cube_scan_set(
    const cube_scan_array *array, void *call, int64_t *length, void *address, const int64_t *shape,
    size_t n_axes);

/* Processes rows from `start` on. Returns the first row that is not processed, or -1 if the arrays do
 * not fit together; `*request` states what the caller has to do before it calls again from there.
 * The numbers in `calibration`, `pads` and `numbers` are not checked: the caller must ensure that they
 * are in range. */
int64_t cube_scan(const cube_scan_call *call, int64_t start, int64_t *request);

/* Arrays of `cube_forces`, which core/compensation/motion.py describes. */
#define CUBE_FORCES_ARRAYS(X)                    \
    X(const int64_t, time_ns, 'i', "M", INPUT)   \
    X(const double, state, 'f', "M43", INPUT)    \
    X(const float, position, 'f', "C3", INPUT)   \
    X(const float, rotation, 'f', "C33", INPUT)  \
    X(const uint16_t, cube, 'u', "N", INPUT)     \
    X(const int64_t, stamp_ns, 'i', "N", INPUT)  \
    X(float, force, 'f', "N3", RESULT)

typedef struct {
    CUBE_FORCES_ARRAYS(CUBE_SCAN_FIELD)
    int64_t length[sizeof CUBE_SCAN_LETTERS];
} cube_forces_call;

#define CUBE_FORCES_N_ARRAYS 7
extern const cube_scan_array cube_forces_arrays[CUBE_FORCES_N_ARRAYS];

/* Returns a call without arrays. */
cube_forces_call cube_forces_begin(void);

/* Computes the specific force at the cube of each row, in the frame of the cube; NaN: unknown. */
void cube_forces(const cube_forces_call *call);

/* Arrays of `cube_filter`, which core/compensation/low_pass.py describes. Here K is the number of
 * low-pass filters of each cube. */
#define CUBE_FILTER_ARRAYS(X)                     \
    X(const double, time_s, 'f', "KC", INPUT)     \
    X(const double, weight, 'f', "KCP", INPUT)    \
    X(const double, elapsed_s, 'f', "C", INPUT)   \
    X(const double, before, 'f', "CP", INPUT)     \
    X(const double, now, 'f', "CP", INPUT)        \
    X(const double, ahead_s, 'f', "C", INPUT)     \
    X(double, lag, 'f', "KCP", RESULT)            \
    X(double, share, 'f', "KC", RESULT)           \
    X(double, sums, 'f', "3CP", RESULT)

typedef struct {
    CUBE_FILTER_ARRAYS(CUBE_SCAN_FIELD)
    int64_t length[sizeof CUBE_SCAN_LETTERS];
} cube_filter_call;

#define CUBE_FILTER_N_ARRAYS 9
extern const cube_scan_array cube_filter_arrays[CUBE_FILTER_N_ARRAYS];

/* Returns a call without arrays. */
cube_filter_call cube_filter_begin(void);

/* Advances the low-pass filters, and adds up their outputs. */
void cube_filter(const cube_filter_call *call);

#endif
