// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

#include "cube_scan.h"

#include "cube_vector.h"

#include <math.h>
#include <string.h>

/* Bits of core/status.py, and limits of core/health/statistics.py. */
enum { PAD_FAULT = 1, RESIDUAL = 2, INVALID = 4, TEMPERATURE = 8, STAMP = 2048, COMPENSATION = 4096 };
static const int64_t GAP_NS = 50000000;
static const double MAX_JITTER_RATIO = 1.5;

/* Limits of core/kernel/contract.py. */
static const int64_t MAX_GAP_NS = 5000000000;
static const float MAX_SPECIFIC_FORCE = 1000;

/* Limits of core/compensation/motion.py. */
static const int64_t MAX_EXTRAPOLATION_NS = 20000000, MAX_INTERVAL_NS = 200000000;

/* Quantities of each pad: PAD_QUANTITIES in core/kernel/contract.py. */
enum { LAST, DIFFERENCE, FIRST_SQUARES, SECOND_SQUARES, BOUNDED_SQUARES, SUM, LOWEST, HIGHEST };
enum { BASE = HIGHEST + 1, BOUND, LOW, HIGH, QUANTITIES };

enum { N, C, P, G, D, T, E, K, Q, M }; /* index of each letter in CUBE_SCAN_LETTERS */
enum { ROWS = 32, LANES_OF_BLOCK = ROWS * CUBE_SCAN_MAX_PADS };

/* Rows that are processed together: successive cubes of one scan, whose pads are adjacent in all
 * arrays. Each operation is one loop over the pads of all rows, which the compiler vectorises. */
typedef struct {
    int64_t row, cube, n_rows; /* first row and its cube */
    float v[LANES_OF_BLOCK], rest[LANES_OF_BLOCK], highest[LANES_OF_BLOCK]; /* by row and pad */
    float out[ROWS][CUBE_SCAN_MAX_OUTPUTS];
    int32_t table[ROWS];
    bool is_over_limit[ROWS];
} block;

INLINE uint32_t mask_of(int32_t pads) {
    return pads >= 32 ? UINT32_MAX : (UINT32_C(1) << pads) - 1;
}

INLINE cube_state *state_of(const cube_scan_call *call, int64_t cube) {
    return (cube_state *)(void *)call->words + cube;
}

INLINE float *quantity(const cube_scan_call *call, int64_t number, int64_t cube) {
    return call->quantities + (number * call->length[C] + cube) * call->length[P];
}

/* Returns the number of the table of a key, by bisection; -1 if there is none. */
static int32_t find_table(const cube_scan_call *call, int64_t key) {
    int64_t low = 0, high = call->length[E];
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (call->keys[middle] < key)
            low = middle + 1;
        else
            high = middle;
    }
    return low < call->length[E] && call->keys[low] == key ? call->numbers[low] : -1;
}

/* Returns the request that the caller must handle before the scan that begins with `row`: a new window
 * of health or a new step of the compensation, if the newest time stamp of the scan lies outside the
 * present one; otherwise CUBE_SCAN_DONE. */
static int64_t find_due(const cube_scan_call *call, int64_t row) {
    const int64_t *window_ns = call->window_ns, *step_ns = call->step_ns;
    int64_t newest_ns = call->stamp_ns[row];
    for (row++; row < call->length[N] && call->cube[row] > call->cube[row - 1]; row++)
        newest_ns = call->stamp_ns[row] > newest_ns ? call->stamp_ns[row] : newest_ns;
    if (window_ns != NULL) {
        call->window_ns[2] = newest_ns;
        if (newest_ns < window_ns[0] || newest_ns >= window_ns[1])
            return CUBE_SCAN_WINDOW;
    }
    if (step_ns != NULL && (newest_ns < step_ns[0] || newest_ns >= step_ns[1]))
        return CUBE_SCAN_STEP;
    return CUBE_SCAN_DONE;
}

/* Multiplies the frequency without load f0 and the highest frequency f_highest of the pads of a row by
 * 1 + sum_d c_d (T - reference)^d (Horner's scheme), with the temperature T of the row. Without a
 * temperature model, or if T is unknown, they are not changed. */
static void warm_row(const cube_scan_call *call, block *b, int64_t i) {
    const int64_t n = call->length[P], n_degrees = call->length[D];
    const int64_t row = b->row + i, at = (b->cube + i) * n, calibration = call->calibration[b->cube + i];
    const double reference = call->reference[calibration];
    const double change = (double)call->temperature[row] - reference;
    const double *c = call->coefficients + calibration * n_degrees * n;
    for (int64_t p = 0; p < n; p++) {
        double sum = 0;
        for (int64_t d = n_degrees - 1; isfinite(change) && d >= 0; d--)
            sum = (sum + c[d * n + p]) * change;
        b->rest[i * n + p] = (float)((double)call->rest[at + p] * (1 + sum));
        b->highest[i * n + p] = (float)((double)call->highest[at + p] * (1 + sum));
    }
    if (!isnan(reference) && !isfinite(change))
        call->status[row] |= TEMPERATURE;
}

/* Computes v = (f - f0) / (f_highest - f), the stress on a pad divided by its stiffness, by the pad law
 * (Kiyota & Shinoda, eq. 6). v is 0 unless 0 < f < f_highest, which is also false for NaN.
 *
 * Returns the number of pads with 0 < f < f_highest and, if health is judged, with f between their
 * lowest and highest possible frequency. */
INLINE int64_t apply_law(const cube_scan_call *call, block *b, const float *rest, const float *highest) {
    const int64_t n_lanes = b->n_rows * call->length[P];
    const float *f = call->frequency + b->row * call->length[P];
    int32_t n_good = 0, n_possible = 0;
    LANES for (int64_t l = 0; l < n_lanes; l++) {
        const float below = highest[l] - f[l], quotient = (f[l] - rest[l]) / below;
        const bool is_good = (f[l] > 0) & (below > 0);
        b->v[l] = is_good ? quotient : 0;
        n_good += is_good;
    }
    if (call->words == NULL)
        return n_good;
    const float *low = quantity(call, LOW, b->cube), *high = quantity(call, HIGH, b->cube);
    LANES for (int64_t l = 0; l < n_lanes; l++)
        n_possible += (f[l] > low[l]) & (f[l] < high[l]);
    return n_good < n_possible ? n_good : n_possible;
}

/* Subtracts from v (pad stress / stiffness) of a row what is no load: offset + (slope + gain * v) *
 * (time since since_ns) for creep and temperature, and response * force for weight. Sets the status
 * bits of the effects that are subtracted. */
INLINE void subtract_offsets(const cube_scan_call *call, block *b, int64_t i, int64_t n) {
    const int64_t row = b->row + i, cube = b->cube + i;
    const float *offset = call->offset + cube * n, *slope = call->slope + cube * n;
    const float *gain = call->gain + cube * n;
    float *v = b->v + i * n, *reading = call->reading + cube * n, *sum = call->subtracted + cube * n;
    const int64_t stamp_ns = call->stamp_ns[row];
    const int64_t elapsed_ns = (int64_t)((uint64_t)stamp_ns - (uint64_t)call->since_ns[cube]);
    const float elapsed = elapsed_ns > 0 ? (float)((double)elapsed_ns * 1e-9) : 0;
    const bool is_near = elapsed_ns >= 0 && elapsed_ns <= MAX_GAP_NS;
    const uint16_t lasting = call->lasting[cube];
    call->status[row] |= is_near || lasting == 0 ? lasting : COMPENSATION;
    call->newest_ns[cube] = stamp_ns;
    LANES for (int64_t p = 0; p < n; p++) {
        reading[p] = v[p];
        sum[p] = offset[p] + (slope[p] + gain[p] * v[p]) * elapsed;
    }
    if (call->force != NULL) {
        const float *force = call->force + row * 3, *response = call->response + cube * 3 * n;
        float used[3];
        bool is_known = true;
        for (int axis = 0; axis < 3; axis++)
            is_known &= fabsf(force[axis]) < MAX_SPECIFIC_FORCE; /* false for NaN */
        for (int axis = 0; axis < 3; axis++) {
            used[axis] = is_known ? force[axis] : 0;
            call->newest_force[cube * 3 + axis] = is_known ? force[axis] : NAN;
        }
        call->status[row] |= is_known ? call->weighing[cube] : COMPENSATION;
        LANES for (int64_t p = 0; p < n; p++) {
            sum[p] += response[p] * used[0];
            sum[p] += response[n + p] * used[1];
            sum[p] += response[2 * n + p] * used[2];
        }
    }
    LANES for (int64_t p = 0; p < n; p++)
        v[p] -= sum[p];
    if (call->row_offset != NULL)
        memcpy(call->row_offset + row * n, sum, (size_t)n * sizeof *sum);
}

/* Sets `left_out` (mask of pads that are not used) and `status` (conditions of the pads) of a row from
 * the health of its cube. Returns whether a pad may be bad. */
INLINE bool get_health(const cube_scan_call *call, int64_t row, int64_t cube) {
    const bool has_health = call->words != NULL;
    if (has_health && (call->known == NULL || !call->known[row])) {
        call->left_out[row] = call->pad_fault[row] | state_of(call, cube)->mask;
        call->status[row] = state_of(call, cube)->status;
    }
    call->status[row] |= call->doubt[row] & STAMP;
    return call->left_out[row] != 0 || (has_health && call->pad_fault[row] != 0);
}

/* Finds the table of a row whose pads may be bad, and sets v of the bad pads to 0. Returns the request
 * that the caller must handle before this row can be processed, or CUBE_SCAN_DONE. */
static int64_t leave_out(const cube_scan_call *call, block *b, int64_t i, const float *highest) {
    const int64_t n = call->length[P], row = b->row + i, cube = b->cube + i;
    const int32_t calibration = b->table[i];
    const uint32_t exists = mask_of(call->pads[calibration]);
    const float *f = call->frequency + row * n;
    uint32_t bad = call->left_out[row], impossible = 0;
    for (int64_t p = 0; p < n; p++) {
        const bool is_good = f[p] > 0 && highest[i * n + p] - f[p] > 0;
        bad |= (uint32_t)!is_good << p;
        if (call->words != NULL)
            impossible |= (uint32_t) !(f[p] > quantity(call, LOW, cube)[p] &&
                                       f[p] < quantity(call, HIGH, cube)[p])
                          << p;
    }
    if (call->words != NULL &&
        ((impossible | call->pad_fault[row]) & exists & ~state_of(call, cube)->found) != 0)
        return CUBE_SCAN_CONDITION;
    bad &= exists;
    if (bad == 0)
        return CUBE_SCAN_DONE;
    for (int64_t p = 0; p < n; p++)
        if (bad >> p & 1) {
            b->v[i * n + p] = 0;
            if (call->since_ns != NULL)
                call->reading[cube * n + p] = NAN;
        }
    const int64_t key = (int64_t)calibration << 32 | bad;
    b->table[i] = find_table(call, key);
    if (b->table[i] < 0)
        return key;
    call->left_out[row] |= bad;
    call->status[row] |= PAD_FAULT;
    return CUBE_SCAN_DONE;
}

/* Computes the outputs of a row: out_k = sum over pads p of v_p * matrix_pk. The terms are added in
 * the order of the pads, so that all processors give the same bits. */
INLINE void multiply(const cube_scan_call *call, const float *restrict v, int32_t table, float *restrict out) {
    const int64_t n = call->length[P], n_outputs = call->length[K];
    for (int64_t k = 0; k < n_outputs; k += CUBE_SCAN_BLOCK) {
        const float *m = call->matrix + table * n * n_outputs + k;
        float sum[CUBE_SCAN_BLOCK];
        LANES for (int j = 0; j < CUBE_SCAN_BLOCK; j++)
            sum[j] = 0 + v[0] * m[j];
        for (int64_t p = 1; p < n; p++) {
            m += n_outputs;
            LANES for (int j = 0; j < CUBE_SCAN_BLOCK; j++)
                sum[j] += v[p] * m[j];
        }
        LANES for (int j = 0; j < CUBE_SCAN_BLOCK; j++)
            out[k + j] = sum[j];
    }
}

/* Writes the results of a row. The residual, sqrt(chi-square / degrees of freedom), is the root of the
 * sum of squares of the outputs after the 15 components. Returns whether it is above its limit. */
INLINE bool write_row(const cube_scan_call *call, int64_t row, const float *out, int32_t table) {
    float squares = 0;
    for (int64_t k = CUBE_SCAN_COMPONENTS; k < CUBE_SCAN_COMPONENTS + call->n_residuals; k++)
        squares += out[k] * out[k];
    const float residual = sqrtf(squares);
    const size_t n_gradient = CUBE_SCAN_COMPONENTS - CUBE_SCAN_STRESS;
    memcpy(call->stress + row * CUBE_SCAN_STRESS, out, CUBE_SCAN_STRESS * sizeof *out);
    memcpy(call->gradient + row * (int64_t)n_gradient, out + CUBE_SCAN_STRESS, n_gradient * sizeof *out);
    call->residual[row] = residual;
    call->row_observed[row] = call->observed[table];
    const bool is_over_limit = residual > call->limit[table];
    call->status[row] |= is_over_limit ? RESIDUAL : 0;
    call->status[row] |= call->observed[table] == 0 ? INVALID : 0;
    return is_over_limit;
}

INLINE uint64_t magnitude(int64_t value) {
    return value < 0 ? 0 - (uint64_t)value : (uint64_t)value;
}

/* Computes ratio r and weight w of the second difference of a frequency, from the last two intervals
 * between rows of a cube:
 *
 *     r = interval / interval before,   w = 6 / (1 + (1 + r)^2 + r^2)
 *
 * r = 1 if both intervals are equal except for jitter. w = 0 if an interval is a gap, or a time stamp
 * at one of its ends is doubtful. */
INLINE void measure_pace(cube_state *state, int64_t stamp_ns, bool is_doubtful, float *r, float *w) {
    const int64_t between = (int64_t)((uint64_t)stamp_ns - (uint64_t)state->time_ns);
    const int64_t before = state->interval_ns;
    const int64_t now = is_doubtful || state->is_doubtful != 0 ? 0 : between;
    state->time_ns = stamp_ns;
    state->interval_ns = now;
    state->is_doubtful = is_doubtful;
    if (between < 0 || between >= GAP_NS) {
        if (state->rows == 0)
            state->gap_before = between;
        else if (magnitude(between) > magnitude(state->gap_within))
            state->gap_within = between;
    }
    const int64_t shorter = now < before ? now : before, longer = now < before ? before : now;
    const bool is_known = shorter > 0 && longer < GAP_NS;
    *r = 1;
    *w = is_known ? 1 : 0;
    if (is_known && !((double)longer < MAX_JITTER_RATIO * (double)shorter)) {
        const double ratio = (double)now / (double)before;
        *r = (float)ratio;
        *w = (float)(6 / (1 + (1 + ratio) * (1 + ratio) + ratio * ratio));
    }
}

/* Adds the rows of a block to the sums of the present window of health: with the first difference
 * d[n] = f[n] - f[n-1] and the second difference e[n] = d[n] - r d[n-1] of a frequency f, the sums of
 * d^2, w e^2, min(w e^2, bound) and f - base. core/health/statistics.py derives them. */
INLINE void add_to_window(const cube_scan_call *call, block *b) {
    const int64_t n = call->length[P], n_lanes = b->n_rows * n, cube = b->cube;
    float *ratio = b->rest, *weight = b->highest; /* `rest` and `highest` are no longer needed */
    for (int64_t i = 0; i < b->n_rows; i++) {
        cube_state *state = state_of(call, cube + i);
        const int64_t row = b->row + i;
        float r, w;
        measure_pace(state, call->stamp_ns[row], (call->doubt[row] & STAMP) != 0, &r, &w);
        for (int64_t p = 0; p < n; p++) {
            ratio[i * n + p] = r;
            weight[i * n + p] = w;
        }
        state->temperature = call->temperature[row];
        state->rows++;
        state->over_limit += b->is_over_limit[i];
    }
    const float *frequency = call->frequency + b->row * n;
    float *last = quantity(call, LAST, cube), *difference = quantity(call, DIFFERENCE, cube);
    float *first_squares = quantity(call, FIRST_SQUARES, cube);
    float *second_squares = quantity(call, SECOND_SQUARES, cube);
    float *bounded_squares = quantity(call, BOUNDED_SQUARES, cube), *sum = quantity(call, SUM, cube);
    float *lowest = quantity(call, LOWEST, cube), *highest = quantity(call, HIGHEST, cube);
    const float *base = quantity(call, BASE, cube), *bound = quantity(call, BOUND, cube);
    LANES for (int64_t l = 0; l < n_lanes; l++) {
        const float f = frequency[l], d = f - last[l], e = d - ratio[l] * difference[l];
        const float square = e * e * weight[l];
        second_squares[l] += square;
        bounded_squares[l] += square > bound[l] ? bound[l] : square; /* NaN stays NaN */
        first_squares[l] += d * d;
        sum[l] += f - base[l];
        lowest[l] = f < lowest[l] ? f : lowest[l]; /* NaN is ignored */
        highest[l] = f > highest[l] ? f : highest[l];
        difference[l] = d;
        last[l] = f;
    }
}

/* Processes the rows of a block, up to the first one whose table is missing. */
INLINE int64_t process_block(const cube_scan_call *call, block *b) {
    const int64_t n = call->length[P];
    const float *rest = call->rest + b->cube * n, *highest = call->highest + b->cube * n;
    bool is_doubtful = false;
    int64_t n_pads = 0, request = CUBE_SCAN_DONE;
    for (int64_t i = 0; i < b->n_rows; i++) {
        b->table[i] = call->calibration[b->cube + i];
        n_pads += call->pads[b->table[i]];
        is_doubtful |= get_health(call, b->row + i, b->cube + i);
    }
    if (call->length[D] > 0) {
        for (int64_t i = 0; i < b->n_rows; i++)
            warm_row(call, b, i);
        rest = b->rest;
        highest = b->highest;
    }
    const int64_t n_good = apply_law(call, b, rest, highest);
    for (int64_t i = 0; i < b->n_rows && call->since_ns != NULL; i++)
        if (n == 8) /* a constant, so that the loops over pads become few instructions */
            subtract_offsets(call, b, i, 8);
        else
            subtract_offsets(call, b, i, n);
    if (n_good != n_pads || is_doubtful)
        for (int64_t i = 0; i < b->n_rows; i++) {
            request = leave_out(call, b, i, highest);
            if (request != CUBE_SCAN_DONE)
                b->n_rows = i;
        }
    for (int64_t i = 0; i < b->n_rows; i++)
        multiply(call, b->v + i * n, b->table[i], b->out[i]);
    for (int64_t i = 0; i < b->n_rows; i++)
        b->is_over_limit[i] = write_row(call, b->row + i, b->out[i], b->table[i]);
    if (call->words != NULL)
        add_to_window(call, b);
    return request;
}

CLONES static int64_t process(const cube_scan_call *call, int64_t start, int64_t *request) {
    const uint16_t *cube = call->cube;
    block b;
    *request = CUBE_SCAN_DONE;
    for (b.row = start; b.row < call->length[N] && *request == CUBE_SCAN_DONE; b.row += b.n_rows) {
        b.cube = cube[b.row];
        b.n_rows = 1;
        if (b.cube >= call->length[C]) {
            *request = CUBE_SCAN_UNKNOWN_CUBE;
            return b.row;
        }
        /* A scan begins where the cube number does not rise. */
        const bool is_begin = b.row == 0 || cube[b.row] <= cube[b.row - 1];
        if (is_begin && (*request = find_due(call, b.row)) != CUBE_SCAN_DONE)
            return b.row;
        while (b.n_rows < ROWS && b.row + b.n_rows < call->length[N] &&
               cube[b.row + b.n_rows] == b.cube + b.n_rows && b.cube + b.n_rows < call->length[C])
            b.n_rows++;
        *request = process_block(call, &b);
    }
    return b.row;
}

int64_t cube_scan(const cube_scan_call *call, int64_t start, int64_t *request) {
    const int64_t n_outputs = call->length[K];
    const bool has_health = call->words != NULL, has_offsets = call->since_ns != NULL;
    const void *offsets[] = {call->step_ns, call->offset, call->slope, call->gain, call->lasting,
                             call->response, call->weighing, call->newest_ns, call->reading, call->subtracted,
                             call->newest_force};
    for (size_t i = 0; i < sizeof offsets / sizeof *offsets; i++)
        if ((offsets[i] != NULL) != has_offsets)
            return -1;
    if (start < 0 || call->length[P] > CUBE_SCAN_MAX_PADS || n_outputs % CUBE_SCAN_BLOCK != 0 ||
        n_outputs > CUBE_SCAN_MAX_OUTPUTS || call->n_residuals > n_outputs - CUBE_SCAN_COMPONENTS ||
        (call->quantities != NULL) != has_health || (call->window_ns != NULL) != has_health)
        return -1;
    /* A call with a cube that the skin does not have is refused before it changes any state. */
    bool is_unknown = false;
    for (int64_t row = start; has_health && row < call->length[N]; row++)
        is_unknown |= call->cube[row] >= call->length[C];
    *request = CUBE_SCAN_UNKNOWN_CUBE;
    return is_unknown ? start : process(call, start, request);
}

/* Interpolates the motion of the skin to a time, linearly between the instants `first` and `first` + 1;
 * NaN if it is unknown then. Times of a damaged recording may be any numbers, so differences wrap. */
static void interpolate(const cube_forces_call *call, int64_t first, int64_t stamp_ns, float *state) {
    const int64_t n = call->length[M], *time_ns = call->time_ns + first;
    const double *before = call->state + first * 12;
    double share = NAN;
    if (n > 1) {
        const int64_t length_ns = (int64_t)((uint64_t)time_ns[1] - (uint64_t)time_ns[0]);
        const int64_t elapsed_ns = (int64_t)((uint64_t)stamp_ns - (uint64_t)time_ns[0]);
        if (length_ns > 0 && length_ns <= MAX_INTERVAL_NS) {
            const int64_t twice_ns = 2 * length_ns;
            const int64_t limit_ns = twice_ns > MAX_EXTRAPOLATION_NS ? twice_ns : MAX_EXTRAPOLATION_NS;
            if (elapsed_ns >= -limit_ns && elapsed_ns <= length_ns + limit_ns)
                share = (double)elapsed_ns / (double)length_ns;
        }
    }
    for (int k = 0; k < 12; k++)
        state[k] = n < 2 ? (n == 1 ? (float)before[k] : NAN)
                         : (float)(before[k] + (before[12 + k] - before[k]) * share);
}

void cube_forces(const cube_forces_call *call) {
    const int64_t last = call->length[M] - 2, *time_ns = call->time_ns;
    float state[12]; /* specific force at the origin, then its gradient */
    int64_t first = 0;
    for (int64_t row = 0; row < call->length[N]; row++) {
        const int64_t cube = call->cube[row], stamp_ns = call->stamp_ns[row];
        if (row == 0 || stamp_ns != call->stamp_ns[row - 1]) {
            while (first > 0 && time_ns[first] > stamp_ns)
                first--;
            while (first < last && time_ns[first + 1] <= stamp_ns)
                first++;
            interpolate(call, first, stamp_ns, state);
        }
        const float *r = call->position + cube * 3, *rotation = call->rotation + cube * 9;
        const bool is_known = cube < call->length[C];
        for (int axis = 0; axis < 3; axis++)
            call->force[row * 3 + axis] = is_known ? 0 : NAN;
        for (int i = 0; i < 3 && is_known; i++) {
            const float *g = state + 3 + i * 3;
            const float in_parent = state[i] + g[0] * r[0] + g[1] * r[1] + g[2] * r[2];
            for (int axis = 0; axis < 3; axis++)
                call->force[row * 3 + axis] += in_parent * rotation[i * 3 + axis];
        }
    }
}

/* Computes the share m = 1 - exp(-ratio) for a ratio from 0 on, and m / ratio.
 * `compute_relaxed_share` in core/compensation/low_pass.py explains the series. */
INLINE void relax(double ratio, double *share, double *mean) {
    const double part = (ratio < 64 ? ratio : 64) / 1024;
    double m = 0;
    for (int n = 9; n > 0; n--)
        m = part / n * (1 - m);
    for (int halving = 0; halving < 10; halving++)
        m *= 2 - m;
    *share = m;
    *mean = ratio > 0 ? m / (ratio > 1e-300 ? ratio : 1e-300) : 1;
}

CLONES void cube_filter(const cube_filter_call *call) {
    const int64_t n_cubes = call->length[C], n = call->length[P], n_lanes = n_cubes * n;
    const double *elapsed = call->elapsed_s, *ahead = call->ahead_s, *before = call->before, *now = call->now;
    double *restrict output = call->sums, *restrict slope = output + n_lanes, *restrict gain = slope + n_lanes;
    memset(call->sums, 0, (size_t)n_lanes * 3 * sizeof *call->sums);
    for (int64_t k = 0; k < call->length[K]; k++) {
        const double *time = call->time_s + k * n_cubes, *weight = call->weight + k * n_lanes;
        double *restrict lag = call->lag + k * n_lanes;
        for (int64_t begin = 0, end = 0; begin < n_cubes; begin = end) {
            double share, mean, ahead_share, ahead_mean;
            relax(elapsed[begin] / time[begin], &share, &mean);
            relax(ahead[begin] / time[begin], &ahead_share, &ahead_mean);
            const double kept = 1 - share, of_lag = ahead_share / ahead[begin];
            const double of_change = (1 - ahead_mean) / ahead[begin];
            /* Successive cubes often have the same time constant and intervals. */
            do
                call->share[k * n_cubes + end++] = share;
            while (end < n_cubes && time[end] == time[begin] && elapsed[end] == elapsed[begin] &&
                   ahead[end] == ahead[begin]);
            LANES for (int64_t l = begin * n; l < end * n; l++) {
                lag[l] = lag[l] * kept + mean * (now[l] - before[l]);
                output[l] += weight[l] * (now[l] - lag[l]);
                slope[l] += weight[l] * lag[l] * of_lag;
                gain[l] += weight[l] * of_change;
            }
        }
    }
    LANES for (int64_t l = 0; l < n_lanes; l++)
        slope[l] -= gain[l] * now[l];
}

#define SCAN(type, name, kind, shape, use) \
    {#name, shape, offsetof(cube_scan_call, name), sizeof(type), kind, CUBE_SCAN_##use},
#define FORCES(type, name, kind, shape, use) \
    {#name, shape, offsetof(cube_forces_call, name), sizeof(type), kind, CUBE_SCAN_##use},
#define FILTER(type, name, kind, shape, use) \
    {#name, shape, offsetof(cube_filter_call, name), sizeof(type), kind, CUBE_SCAN_##use},
const cube_scan_array cube_scan_arrays[CUBE_SCAN_N_ARRAYS] = {CUBE_SCAN_ARRAYS(SCAN)};
const cube_scan_array cube_forces_arrays[CUBE_FORCES_N_ARRAYS] = {CUBE_FORCES_ARRAYS(FORCES)};
const cube_scan_array cube_filter_arrays[CUBE_FILTER_N_ARRAYS] = {CUBE_FILTER_ARRAYS(FILTER)};
_Static_assert(sizeof(cube_state) == 8 * 8, "the shape of words");

cube_scan_call cube_scan_begin(void) {
    cube_scan_call call = {0};
    memset(call.length, -1, sizeof call.length);
    call.length[Q] = QUANTITIES;
    return call;
}

cube_forces_call cube_forces_begin(void) {
    cube_forces_call call = {0};
    memset(call.length, -1, sizeof call.length);
    return call;
}

cube_filter_call cube_filter_begin(void) {
    cube_filter_call call = {0};
    memset(call.length, -1, sizeof call.length);
    return call;
}

bool cube_scan_set(
    const cube_scan_array *array, void *call, int64_t *length, void *address, const int64_t *shape,
    size_t n_axes) {
    memcpy((char *)call + array->offset, &address, sizeof address);
    for (size_t axis = 0; axis < n_axes; axis++) {
        const char *letter = strchr(CUBE_SCAN_LETTERS, array->shape[axis]);
        int64_t fixed = array->shape[axis] - '0';
        int64_t *known = letter == NULL ? &fixed : &length[letter - CUBE_SCAN_LETTERS];
        *known = *known < 0 ? shape[axis] : *known;
        if (*known != shape[axis])
            return false;
    }
    return n_axes == strlen(array->shape);
}
