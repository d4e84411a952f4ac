// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Values of cubes under Hertz contacts on the surface, and their derivatives by the contacts.
 *
 * The readable specification in numpy is mechanics/contact_response.py for the responses and
 * touch/tracker/hertz_response.py for the rest; a test compares it with this code. C and numpy add the
 * terms of sums in different orders, so that their results differ by rounding errors.
 *
 * Results have the same bits on every processor, as in cube_scan.h, except that sines, cosines and
 * logarithms are those of the C library. The functions allocate no memory, make no system calls and keep
 * no state. */
#ifndef CUBE_CONTACT_H
#define CUBE_CONTACT_H

#include "cube_scan.h"

#define CUBE_CONTACT_LANES 16 /* circular components, or outputs, that are computed side by side */
#define CUBE_CONTACT_BLOCK 4  /* parameters whose derivatives are whitened side by side */
#define CUBE_CONTACT_ORDERS 9 /* `N_ORDERS` of touch/pad_measurement.py */

/* Arrays of a call: type, name, kind (of numpy), shape, use. `cube_respond` uses the arrays up to
 * `result`, and `cube_linearise` all but `result`. The tables (`scale` to `matrix` and `change` to
 * `change_matrix`) are from `ContactResponse.collect_tables`.
 *
 * Letters of a shape: N cubes, J contacts, C measured components, V variants of the measurement model, R
 * radii and D distances of the tables, M circular components (mechanics/circular.py; padded to a multiple of
 * 16), K radial functions of each circular component in `response` (3 for each quantity), and G quantities
 * that `cube_respond` computes: the values of the cubes, or their changes by each error of the elastomer.
 * `change` is the table of these changes for `cube_linearise`, with T radial functions. O = 16 is the number
 * of its circular components and of the outputs (measured components), both padded. P is the number of
 * parameters, plus one column for the values, padded to a multiple of 4. */
#define CUBE_CONTACT_ARRAYS(X)                         \
    X(const double, scale, 'f', "5", INPUT)            \
    X(const float, response, 'f', "RDKM", INPUT)       \
    X(const int64_t, order, 'i', "M", INPUT)           \
    X(const float, matrix, 'f', "V2MO", INPUT)         \
    X(const double, place, 'f', "N2", INPUT)           \
    X(const double, angle, 'f', "N", INPUT)            \
    X(const int64_t, variant, 'i', "N", INPUT)         \
    X(const double, force, 'f', "J3", INPUT)           \
    X(const double, centre, 'f', "J2", INPUT)          \
    X(const double, log_size, 'f', "J", INPUT)         \
    X(double, result, 'f', "NGC", STATE)               \
    X(const float, change, 'f', "RDTO", INPUT)         \
    X(const int64_t, change_order, 'i', "O", INPUT)    \
    X(const float, change_matrix, 'f', "12OO", INPUT)  \
    X(const double, whitening, 'f', "NCC", INPUT)      \
    X(double, columns, 'f', "NCP", RESULT)             \
    X(double, white, 'f', "NCP", RESULT)

typedef struct {
    CUBE_CONTACT_ARRAYS(CUBE_SCAN_FIELD)
    int64_t length[sizeof CUBE_SCAN_LETTERS];
} cube_contact_call;

#define CUBE_RESPOND_N_ARRAYS 11
#define CUBE_CONTACT_N_ARRAYS 17
extern const cube_scan_array cube_contact_arrays[CUBE_CONTACT_N_ARRAYS];

/* Returns a call without arrays. */
cube_contact_call cube_contact_begin(void);

/* Computes G quantities of the cubes, such as their values, summed over the contacts, by linear
 * interpolation in `response`. Three radial functions (R, Z and T in mechanics/circular.py) give one
 * quantity. Returns false if the arrays do not fit together. The numbers in `variant` are not checked. */
bool cube_respond(const cube_contact_call *call);

/* Computes `columns`, the derivatives of the values by the parameters and then the values, and `white`, the
 * same columns whitened (`differentiate` in hertz_response.py, which explains `halfway`). Returns false if
 * the arrays do not fit together. The numbers in `variant` are not checked. */
bool cube_linearise(const cube_contact_call *call, double halfway);

#endif
