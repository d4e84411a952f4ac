// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

#include "cube_contact.h"

#include "cube_vector.h"

#include <math.h>
#include <string.h>

enum { N = 0, C = 1, P = 2, G = 3, D = 4, T = 5, K = 7, M = 9, R, V, O, J }; /* index of each letter in CUBE_SCAN_LETTERS */
enum { STEP, MIN_DISTANCE, FIRST_LOG, LOG_STEP, STRESSES };    /* numbers in `scale` */
enum { WIDTH = CUBE_CONTACT_LANES, BLOCK = CUBE_CONTACT_BLOCK, SETS = 8 };
enum { REAL, IMAGINARY, ORDER };                   /* rows of the array that `gather` fills */
enum { VALUE, BY_DISTANCE, BY_LOG, BY_LOG_TWICE }; /* derivatives in `differentiate` */

/* The same constant as in touch/tracker/hertz_response.py. */
static const float FLATNESS_STEP = 0.2f;

/* `_CUBIC_LAGRANGE` of mechanics/distance_table.py, times 6: coefficients of 1, t, t^2, t^3 in the weights
 * of four table entries, and in the first and second derivatives of these weights. */
static const double CUBIC_LAGRANGE[3][4][4] = {
    {{0, -2, 3, -1}, {6, -3, -6, 3}, {0, 6, 3, -3}, {0, -1, 0, 1}},
    {{-2, 6, -3, 0}, {-3, -12, 9, 0}, {6, 6, -9, 0}, {-1, 0, 3, 0}},
    {{6, -6, 0, 0}, {-12, 18, 0, 0}, {6, -18, 0, 0}, {0, 6, 0, 0}}};

/* Offset of a cube from a contact, and the force of the contact. */
typedef struct {
    double distance, decay;                      /* `decay`: factor of the last values, beyond the table */
    int64_t row, size_row;                       /* table entries below the distance and the radius */
    double fraction, size_fraction;              /* distance and radius from there, in steps of the table */
    float cosine, sine;                          /* of the direction from the contact to the cube */
    float radial, tangential, normal;            /* force along this direction, across it, and along z */
    float phase[2][CUBE_CONTACT_ORDERS];         /* exp(i m phi) of order m; phi: direction in the cube's frame */
} offset;

/* Finds the offset of a cube from contact j, with all lengths divided by `factor`. A distance below
 * `min_distance` gets the table entries of `min_distance`. Numbers that are not finite get table entries
 * that exist. */
INLINE offset find_offset(
    const cube_contact_call *call, int64_t cube, int64_t j, double factor, double min_distance) {
    const double x = (call->place[2 * cube] - call->centre[2 * j]) / factor;
    const double y = (call->place[2 * cube + 1] - call->centre[2 * j + 1]) / factor;
    const double distance = sqrt(x * x + y * y), *scale = call->scale;
    const double cosine = distance > 0 ? x / distance : 1, sine = distance > 0 ? y / distance : 0;
    offset o = {.distance = distance, .cosine = (float)cosine, .sine = (float)sine};

    const double last = (double)(call->length[D] - 4), last_size = (double)call->length[R] - 2.001;
    const double index = (distance > min_distance ? distance : min_distance) / scale[STEP];
    const double within = index < last ? index : last, ratio = last / (index > last ? index : last);
    const double size_index = (call->log_size[j] - log(factor) - scale[FIRST_LOG]) / scale[LOG_STEP];
    const double size_within = size_index > 1 ? (size_index < last_size ? size_index : last_size) : 1;
    o.decay = ratio * ratio;
    o.row = (int64_t)within;
    o.fraction = within - (double)o.row;
    o.size_row = (int64_t)size_within;
    o.size_fraction = size_within - (double)o.size_row;

    const float fx = (float)call->force[3 * j], fy = (float)call->force[3 * j + 1];
    o.radial = o.cosine * fx + o.sine * fy;
    o.tangential = o.cosine * fy - o.sine * fx;
    o.normal = (float)call->force[3 * j + 2];
    const double cube_cosine = cos(call->angle[cube]), cube_sine = sin(call->angle[cube]);
    const float real = (float)(cosine * cube_cosine + sine * cube_sine);
    const float imaginary = (float)(sine * cube_cosine - cosine * cube_sine);
    o.phase[REAL][0] = 1;
    for (int m = 1; m < CUBE_CONTACT_ORDERS; m++) {
        o.phase[REAL][m] = o.phase[REAL][m - 1] * real - o.phase[IMAGINARY][m - 1] * imaginary;
        o.phase[IMAGINARY][m] = o.phase[REAL][m - 1] * imaginary + o.phase[IMAGINARY][m - 1] * real;
    }
    return o;
}

/* Collects the phases exp(i m phi) of 16 circular components, and their orders m. */
INLINE void gather(const offset *o, const int64_t *order, float (*restrict phase)[WIDTH]) {
    for (int k = 0; k < WIDTH; k++) {
        phase[REAL][k] = o->phase[REAL][order[k]];
        phase[IMAGINARY][k] = o->phase[IMAGINARY][order[k]];
        phase[ORDER][k] = (float)order[k];
    }
}

/* Rotates 16 of n circular components into the frame of the cube, and adds what they contribute to the
 * outputs (measured components). */
INLINE void measure(
    float (*phase)[WIDTH], const float *real, const float *imaginary, const float *matrix, int64_t n,
    float *restrict out) {
    float rotated[2][WIDTH], sum[WIDTH];
    memcpy(sum, out, sizeof sum);
    LANES for (int k = 0; k < WIDTH; k++) {
        rotated[REAL][k] = real[k] * phase[REAL][k] - imaginary[k] * phase[IMAGINARY][k];
        rotated[IMAGINARY][k] = real[k] * phase[IMAGINARY][k] + imaginary[k] * phase[REAL][k];
    }
    for (int part = 0; part < 2; part++)
        for (int k = 0; k < WIDTH; k++)
            LANES for (int c = 0; c < WIDTH; c++)
                sum[c] += rotated[part][k] * matrix[(part * n + k) * WIDTH + c];
    memcpy(out, sum, sizeof sum);
}

/* Adds the outputs (measured components) under the force of a contact, by linear interpolation, like
 * `_respond_fast` of mechanics/contact_response.py. A row of the table has `n_functions` radial functions of
 * n circular components; the first three functions are used. */
INLINE void respond(
    const cube_contact_call *call, const offset *o, const float *table, int64_t n_functions,
    const int64_t *order, int64_t n, const float *matrix, float *restrict out) {
    const int64_t width = n_functions * n, across = call->length[D] * width;
    const double below = (1 - o->fraction) * o->decay, above = o->fraction * o->decay;
    const double wider = o->size_fraction;
    const float weight[] = {(float)((1 - wider) * below), (float)((1 - wider) * above),
                            (float)(wider * below), (float)(wider * above)};
    const float *corner = table + o->size_row * across + (o->row + 1) * width;
    for (int64_t first = 0; first < n; first += WIDTH) {
        float phase[3][WIDTH], part[3][WIDTH], real[WIDTH], imaginary[WIDTH];
        for (int a = 0; a < 3; a++) {
            const float *row = corner + a * n + first;
            LANES for (int k = 0; k < WIDTH; k++)
                part[a][k] = weight[0] * row[k] + weight[1] * row[width + k] + weight[2] * row[across + k] +
                             weight[3] * row[across + width + k];
        }
        LANES for (int k = 0; k < WIDTH; k++) {
            real[k] = o->radial * part[0][k] + o->normal * part[1][k];
            imaginary[k] = o->tangential * part[2][k];
        }
        gather(o, order + first, phase);
        measure(phase, real, imaginary, matrix + first * WIDTH, n, out);
    }
}

/* Computes the weights of four table entries in the value at t, or in a derivative by t, times `factor`. The
 * second entry is at t = 0, the third one at t = 1. */
INLINE void weigh(double t, int derivative, double factor, float *weight) {
    for (int i = 0; i < 4; i++) {
        const double *c = CUBIC_LAGRANGE[derivative][i];
        weight[i] = (float)((c[0] + t * (c[1] + t * (c[2] + t * c[3]))) / 6 * factor);
    }
}

/* Computes eight sets of outputs, as `compute_response_slopes` of mechanics/contact_response.py, with the
 * same names. */
INLINE void differentiate(
    const cube_contact_call *call, const offset *o, const float *matrix, float (*restrict out)[WIDTH]) {
    const int64_t n = call->length[M], width = 3 * n, across = call->length[D] * width;
    const double *scale = call->scale, log_step = scale[LOG_STEP];
    const double distance = o->distance > scale[MIN_DISTANCE] ? o->distance : scale[MIN_DISTANCE];
    const float inverse = (float)(1 / distance), below = (float)(o->distance - distance);
    const float cosine = o->cosine, sine = o->sine;
    const float radial = o->radial, tangential = o->tangential, normal = o->normal;
    float by_distance[4], slope[4], by_size[4], by_log[4], by_log_twice[4];
    weigh(o->fraction, 0, o->decay, by_distance);
    weigh(o->fraction, 1, o->decay / scale[STEP], slope);
    weigh(o->size_fraction, 0, 1, by_size);
    weigh(o->size_fraction, 1, 1 / log_step, by_log);
    weigh(o->size_fraction, 2, 1 / (log_step * log_step), by_log_twice);
    const float *corner = call->response + (o->size_row - 1) * across + o->row * width;
    memset(out, 0, SETS * sizeof *out);
    for (int64_t first = 0; first < n; first += WIDTH) {
        float phase[3][WIDTH], part[4][3][WIDTH] = {0}, real[SETS][WIDTH], imaginary[SETS][WIDTH];
        for (int i = 0; i < 4; i++)
            for (int a = 0; a < 3; a++) {
                const float *row = corner + i * across + a * n + first;
                LANES for (int k = 0; k < WIDTH; k++) {
                    const float f[] = {row[k], row[width + k], row[2 * width + k], row[3 * width + k]};
                    const float value = by_distance[0] * f[0] + by_distance[1] * f[1] +
                                        by_distance[2] * f[2] + by_distance[3] * f[3];
                    const float change = slope[0] * f[0] + slope[1] * f[1] + slope[2] * f[2] + slope[3] * f[3];
                    part[VALUE][a][k] += by_size[i] * value;
                    part[BY_DISTANCE][a][k] += by_size[i] * change;
                    part[BY_LOG][a][k] += by_log[i] * value;
                    part[BY_LOG_TWICE][a][k] += by_log_twice[i] * value;
                }
            }
        gather(o, call->order + first, phase);
        LANES for (int k = 0; k < WIDTH; k++) {
            const float m = phase[ORDER][k], r = part[VALUE][0][k], z = part[VALUE][1][k], t = part[VALUE][2][k];
            const float r_slope = part[BY_DISTANCE][0][k], z_slope = part[BY_DISTANCE][1][k];
            const float t_slope = part[BY_DISTANCE][2][k];
            const float across_real = inverse * (tangential * r - m * (tangential * t));
            const float across_imaginary = inverse * (m * (radial * r + normal * z) - radial * t);
            const float along_real = radial * r_slope + normal * z_slope, along_imaginary = tangential * t_slope;
            const float true_r = r + below * r_slope, true_t = t + below * t_slope;
            real[0][k] = cosine * true_r;
            imaginary[0][k] = -sine * true_t;
            real[1][k] = sine * true_r;
            imaginary[1][k] = cosine * true_t;
            real[2][k] = z + below * z_slope;
            imaginary[2][k] = 0;
            real[3][k] = sine * across_real - cosine * along_real;
            imaginary[3][k] = sine * across_imaginary - cosine * along_imaginary;
            real[4][k] = -cosine * across_real - sine * along_real;
            imaginary[4][k] = -cosine * across_imaginary - sine * along_imaginary;
            for (int l = 5; l < 7; l++) {
                const int derivative = BY_LOG + l - 5;
                real[l][k] = radial * part[derivative][0][k] + normal * part[derivative][1][k];
                imaginary[l][k] = tangential * part[derivative][2][k];
            }
            real[7][k] = 0;
            imaginary[7][k] = 0.5f * (inverse * (m * r - t) - t_slope);
        }
        for (int l = 0; l < SETS; l++)
            measure(phase, real[l], imaginary[l], matrix + first * WIDTH, n, out[l]);
    }
}

INLINE const float *matrix_of(const cube_contact_call *call, int64_t cube) {
    return call->matrix + call->variant[cube] * 2 * call->length[M] * WIDTH;
}

/* Computes the derivatives of the values of one cube by the parameters, and the values. */
INLINE void fill_columns(const cube_contact_call *call, int64_t cube, double halfway, double *columns) {
    const int64_t n = call->length[C], width = call->length[P], n_stresses = (int64_t)call->scale[STRESSES];
    const int64_t first_error = SETS * call->length[J], values = first_error + call->length[T] / 3;
    for (int64_t j = 0; j < call->length[J]; j++) {
        float out[SETS][WIDTH];
        const offset o = find_offset(call, cube, j, 1, call->scale[MIN_DISTANCE]);
        differentiate(call, &o, matrix_of(call, cube), out);
        LANES for (int c = 0; c < WIDTH; c++)
            out[6][c] = FLATNESS_STEP * FLATNESS_STEP * (out[5][c] - out[6][c] / 2);
        for (int64_t c = 0; c < n; c++) {
            double *row = columns + c * width;
            for (int l = 0; l < SETS; l++)
                row[SETS * j + l] = (double)out[l][c];
            for (int axis = 0; axis < 3; axis++)
                row[values] += call->force[3 * j + axis] * (double)out[axis][c];
        }
        const offset nearer = find_offset(call, cube, j, halfway, 0);
        for (int64_t column = first_error; column < values; column++) {
            float change[WIDTH] = {0};
            const float *table = call->change + (column - first_error) * 3 * WIDTH;
            respond(call, &nearer, table, call->length[T], call->change_order, WIDTH, call->change_matrix, change);
            for (int64_t c = 0; c < n; c++)
                columns[c * width + column] += (double)change[c] / (c < n_stresses ? 1 : halfway);
        }
    }
}

/* Returns whether lengths and orders of the arrays that both functions use are possible. */
static bool is_possible(const cube_contact_call *call) {
    const int64_t *length = call->length;
    bool is_known = true;
    for (int64_t k = 0; k < length[M]; k++)
        is_known &= call->order[k] >= 0 && call->order[k] < CUBE_CONTACT_ORDERS;
    return is_known && length[M] % WIDTH == 0 && length[C] <= WIDTH && length[R] > 3 && length[D] > 4;
}

CLONES bool cube_respond(const cube_contact_call *call) {
    const int64_t n = call->length[C], n_orders = call->length[M], n_quantities = call->length[G];
    if (!is_possible(call) || call->result == NULL || call->length[K] != 3 * n_quantities)
        return false;
    memset(call->result, 0, (size_t)(call->length[N] * n_quantities * n) * sizeof(double));
    for (int64_t cube = 0; cube < call->length[N]; cube++)
        for (int64_t j = 0; j < call->length[J]; j++) {
            const offset o = find_offset(call, cube, j, 1, 0);
            for (int64_t g = 0; g < n_quantities; g++) {
                float out[WIDTH] = {0};
                const float *table = call->response + g * 3 * n_orders;
                respond(call, &o, table, 3 * n_quantities, call->order, n_orders, matrix_of(call, cube), out);
                for (int64_t c = 0; c < n; c++)
                    call->result[(cube * n_quantities + g) * n + c] += (double)out[c];
            }
        }
    return true;
}

CLONES bool cube_linearise(const cube_contact_call *call, double halfway) {
    const int64_t n = call->length[C], width = call->length[P], size = n * width;
    bool is_change_possible = call->length[T] % 3 == 0;
    for (int64_t k = 0; k < WIDTH; k++)
        is_change_possible &= call->change_order[k] >= 0 && call->change_order[k] < CUBE_CONTACT_ORDERS;
    if (!is_possible(call) || !is_change_possible || call->length[K] != 3 || width % BLOCK != 0 ||
        width <= SETS * call->length[J] + call->length[T] / 3)
        return false;
    memset(call->columns, 0, (size_t)(call->length[N] * size) * sizeof(double));
    for (int64_t cube = 0; cube < call->length[N]; cube++) {
        double *columns = call->columns + cube * size, *white = call->white + cube * size;
        fill_columns(call, cube, halfway, columns);
        /* The whitening matrix is the inverse of a Cholesky factor, so it is lower triangular. */
        const double *whitening = call->whitening + cube * n * n;
        for (int64_t c = 0; c < n; c++)
            for (int64_t first = 0; first < width; first += BLOCK) {
                double sum[BLOCK] = {0};
                for (int64_t d = 0; d <= c; d++)
                    LANES for (int l = 0; l < BLOCK; l++)
                        sum[l] += whitening[c * n + d] * columns[d * width + first + l];
                memcpy(white + c * width + first, sum, sizeof sum);
            }
    }
    return true;
}

#define CONTACT(type, name, kind, shape, use) \
    {#name, shape, offsetof(cube_contact_call, name), sizeof(type), kind, CUBE_SCAN_##use},
const cube_scan_array cube_contact_arrays[CUBE_CONTACT_N_ARRAYS] = {CUBE_CONTACT_ARRAYS(CONTACT)};

cube_contact_call cube_contact_begin(void) {
    cube_contact_call call = {0};
    memset(call.length, -1, sizeof call.length);
    call.length[O] = WIDTH;
    return call;
}
