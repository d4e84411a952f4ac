/* Rows in one precision. cube_scan.c includes this file twice: REAL is float or double, and
 * NAME(x) appends it to a name. */

/* Pad law: v = (f - f0) / (f_highest - f), which is the stress on a pad over its stiffness.
 *
 * Source: Kiyota & Shinoda, eq. 6. With a model, f0 and f_highest follow the temperature T:
 * factor = 1 + sum_d c_d (T - reference)^d, by Horner's scheme. v of pads without 0 < f < f_highest
 * is 0; their bits are removed from `*good`. Returns whether all pads have such a frequency and, if
 * health is asked for, one in their possible range. */
INLINE bool NAME(apply_law)(
    const cube_scan_call *call, int64_t n, bool has_health, int64_t row, REAL *restrict v,
    uint32_t *good) {
    const int64_t cube = call->cube[row], calibration = call->calibration[cube];
    const REAL *restrict f = (const REAL *)call->frequency + row * n;
    const REAL *restrict rest = (const REAL *)call->rest + cube * n;
    const REAL *restrict highest = (const REAL *)call->highest + cube * n;
    const float *restrict quantity = (const float *)call->quantities + cube * QUANTITIES * n;
    REAL warm_rest[CUBE_SCAN_MAX_PADS], warm_highest[CUBE_SCAN_MAX_PADS];
    const double reference = call->reference[calibration];
    const double change = (double)call->temperature[row] - reference;
    if (isfinite(change)) {
        const double *c = call->coefficients + calibration * call->n_degrees * n;
        for (int64_t p = 0; p < n; p++) {
            double sum = 0;
            for (int64_t d = call->n_degrees - 1; d >= 0; d--)
                sum = (sum + c[d * n + p]) * change;
            warm_rest[p] = (REAL)((double)rest[p] * (1 + sum));
            warm_highest[p] = (REAL)((double)highest[p] * (1 + sum));
        }
        rest = warm_rest;
        highest = warm_highest;
    } else if (!isnan(reference)) {
        call->status[row] |= TEMPERATURE;
    }

    int32_t n_sound = 0;
LANES
    for (int64_t p = 0; p < n; p++) {
        const REAL below = highest[p] - f[p];
        const bool is_good = (f[p] > 0) & (below > 0); /* false for NaN */
        const REAL quotient = (f[p] - rest[p]) / below;
        v[p] = is_good ? quotient : 0;
        const bool is_possible =
            !has_health ||
            (((float)f[p] > quantity[LOW * n + p]) & ((float)f[p] < quantity[HIGH * n + p]));
        n_sound += is_good & is_possible;
    }
    if (n_sound == call->pads[calibration])
        return true;
    for (int64_t p = 0; p < n; p++)
        if (!(f[p] > 0 && highest[p] - f[p] > 0))
            *good &= ~(UINT32_C(1) << p);
    return false;
}

/* Outputs of a row: out_k = sum over pads p of v_p * matrix_pk, in the order of the pads. */
INLINE void NAME(multiply)(
    const cube_scan_call *call, int64_t n, int64_t table, const REAL *restrict v,
    REAL *restrict out) {
    const REAL *matrix = (const REAL *)call->matrix + table * n * call->n_outputs;
    for (int64_t k = 0; k < call->n_outputs; k += CUBE_SCAN_BLOCK) {
        REAL sum[CUBE_SCAN_BLOCK] = {0};
UNROLL
        for (int64_t p = 0; p < n; p++) {
            const REAL *restrict m = matrix + p * call->n_outputs + k;
            for (int j = 0; j < CUBE_SCAN_BLOCK; j++)
                sum[j] += v[p] * m[j];
        }
        memcpy(out + k, sum, sizeof sum);
    }
}

/* Conditions of the pads of a row: frequencies outside their range, and faults of the device. */
static void NAME(check_pads)(const cube_scan_call *call, int64_t row, uint32_t fault) {
    const int64_t n = call->n_pads, cube = call->cube[row];
    const REAL *f = (const REAL *)call->frequency + row * n;
    const float *quantity = (const float *)call->quantities + cube * QUANTITIES * n;
    for (int32_t p = 0; p < call->pads[call->calibration[cube]]; p++) {
        const float value = (float)f[p];
        uint16_t bits = fault >> p & 1 ? REPORTED : 0;
        if (!(value > 0)) /* true for NaN, too */
            bits |= SHORT;
        else if (value >= quantity[OPEN_FROM * n + p])
            bits |= OPEN;
        else if (!(value > quantity[LOW * n + p] && value < quantity[HIGH * n + p]))
            bits |= RANGE;
        if (bits != 0) {
            call->found[cube * n + p] |= bits;
            call->cubes[cube].status |= bits;
            call->cubes[cube].mask |= UINT32_C(1) << p;
        }
    }
}

/* Sums of the window of health; core/health/statistics.py has the equations.
 *
 * d = f[n] - f[n-1],   e = d[n] - r d[n-1],   sums of d^2, w e^2, min(w e^2, bound) and f - f0. */
INLINE void NAME(add_to_window)(
    const cube_scan_call *call, int64_t n, int64_t row, bool is_over_limit) {
    const int64_t cube = call->cube[row];
    cube_state *state = &call->cubes[cube];
    float ratio, weight;
    measure_pace(state, call->stamp_ns[row], (call->doubt[row] & STAMP) != 0, &ratio, &weight);
    state->temperature = call->temperature[row];
    state->rows++;
    state->over_limit += is_over_limit;
    const REAL *restrict frequency = (const REAL *)call->frequency + row * n;
    float *quantity = (float *)call->quantities + cube * QUANTITIES * n;
    float *restrict last = quantity + LAST * n, *restrict difference = quantity + DIFFERENCE * n;
    float *restrict first_squares = quantity + FIRST_SQUARES * n;
    float *restrict second_squares = quantity + SECOND_SQUARES * n;
    float *restrict bounded_squares = quantity + BOUNDED_SQUARES * n;
    float *restrict sum = quantity + SUM * n;
    float *restrict lowest = quantity + LOWEST * n, *restrict highest = quantity + HIGHEST * n;
    const float *restrict base = quantity + BASE * n, *restrict bound = quantity + BOUND * n;
LANES
    for (int64_t p = 0; p < n; p++) {
        const float f = (float)frequency[p];
        const float d = f - last[p];
        const float e = d - ratio * difference[p];
        const float square = e * e * weight;
        second_squares[p] += square;
        bounded_squares[p] += square > bound[p] ? bound[p] : square; /* NaN stays NaN */
        first_squares[p] += d * d;
        sum[p] += f - base[p];
        lowest[p] = f < lowest[p] ? f : lowest[p]; /* NaN is ignored */
        highest[p] = f > highest[p] ? f : highest[p];
        difference[p] = d;
        last[p] = f;
    }
}

INLINE void NAME(fill_row)(
    const cube_scan_call *call, int64_t row, const REAL *restrict out, REAL residual) {
    const int64_t n_gradient = CUBE_SCAN_COMPONENTS - CUBE_SCAN_STRESS;
    memcpy((REAL *)call->stress + row * CUBE_SCAN_STRESS, out, CUBE_SCAN_STRESS * sizeof *out);
    memcpy(
        (REAL *)call->gradient + row * n_gradient, out + CUBE_SCAN_STRESS,
        (size_t)n_gradient * sizeof *out);
    ((REAL *)call->residual)[row] = residual;
}

/* First step of a row: pad law, health, and the table of its matrix. Returns a request, or DONE. */
INLINE int64_t NAME(prepare)(
    const cube_scan_call *call, int64_t n, bool has_health, int64_t row, REAL *restrict v,
    int32_t *table) {
    if (has_health && !is_in_window(call, row))
        return CUBE_SCAN_WINDOW;
    const int64_t cube = call->cube[row];
    const uint16_t doubt = call->doubt[row] & STAMP;
    *table = UNKNOWN_TABLE;
    if (cube >= call->n_cubes) {
        call->status[row] |= INVALID | doubt;
        return CUBE_SCAN_DONE;
    }
    const bool is_found = has_health && (call->known == NULL || !call->known[row]);
    if (is_found)
        call->status[row] = 0;
    const int32_t calibration = call->calibration[cube];
    const uint32_t exists = mask_of(call->pads[calibration]);
    uint32_t good = exists;
    const bool is_sound = NAME(apply_law)(call, n, has_health, row, v, &good);
    const uint32_t fault = call->pad_fault[row] & exists;
    if (has_health && (!is_sound || fault != 0))
        NAME(check_pads)(call, row, fault);
    if (is_found) {
        call->left_out[row] = call->pad_fault[row] | call->cubes[cube].mask;
        call->status[row] |= call->cubes[cube].status;
    }
    call->status[row] |= doubt;

    const uint32_t bad = exists & (~good | call->left_out[row]);
    *table = calibration;
    if (bad == 0)
        return CUBE_SCAN_DONE;
    const int64_t key = (int64_t)calibration << 32 | bad;
    *table = find_table(call, key);
    if (*table < 0)
        return key;
    for (int64_t p = 0; p < n; p++)
        if (bad >> p & 1)
            v[p] = 0;
    call->left_out[row] |= bad;
    call->status[row] |= PAD_FAULT;
    return CUBE_SCAN_DONE;
}

/* Third step of a row: residual = sqrt(chi-square / degrees of freedom), the root of a sum of
 * squares, and status. Returns whether the residual is above its limit. */
INLINE bool NAME(finish)(
    const cube_scan_call *call, int64_t row, REAL *restrict out, int64_t table) {
    if (table == UNKNOWN_TABLE) {
        for (int k = 0; k < CUBE_SCAN_COMPONENTS; k++)
            out[k] = (REAL)NAN;
        NAME(fill_row)(call, row, out, (REAL)NAN);
        call->row_observed[row] = 0;
        return false;
    }
    REAL squares = 0;
    for (int64_t d = 0; d < call->n_residuals; d++)
        squares += out[CUBE_SCAN_COMPONENTS + d] * out[CUBE_SCAN_COMPONENTS + d];
    const REAL residual = ROOT(squares);
    NAME(fill_row)(call, row, out, residual);
    call->row_observed[row] = call->observed[table];
    if (call->observed[table] == 0)
        call->status[row] |= INVALID;
    if (!(residual > ((const REAL *)call->limit)[table]))
        return false;
    call->status[row] |= RESIDUAL;
    return true;
}

/* Rows are processed in blocks, whose steps are loops of their own: a processor works on several
 * rows at a time in a short loop. */
INLINE int64_t NAME(process_rows)(
    const cube_scan_call *call, int64_t n, bool has_health, int64_t start, int64_t *request) {
    REAL v[ROWS][CUBE_SCAN_MAX_PADS], out[ROWS][CUBE_SCAN_MAX_OUTPUTS];
    int32_t table[ROWS];
    bool is_over_limit[ROWS];
    *request = CUBE_SCAN_DONE;
    while (start < call->n_rows && *request == CUBE_SCAN_DONE) {
        const int64_t rest = call->n_rows - start;
        int64_t count = 0;
        for (; count < rest && count < ROWS; count++) {
            *request = NAME(prepare)(call, n, has_health, start + count, v[count], &table[count]);
            if (*request != CUBE_SCAN_DONE)
                break;
        }
        for (int64_t i = 0; i < count; i++)
            if (table[i] != UNKNOWN_TABLE)
                NAME(multiply)(call, n, table[i], v[i], out[i]);
        for (int64_t i = 0; i < count; i++)
            is_over_limit[i] = NAME(finish)(call, start + i, out[i], table[i]);
        for (int64_t i = 0; has_health && i < count; i++)
            NAME(add_to_window)(call, n, start + i, is_over_limit[i]);
        start += count;
    }
    return start;
}

/* The compiler makes a version with loops of fixed length for the most frequent number of pads. */
CLONES static int64_t NAME(process)(
    const cube_scan_call *call, int64_t start, int64_t *request) {
    const int64_t n = call->n_pads;
    if (n != 8)
        return NAME(process_rows)(call, n, call->cubes != NULL, start, request);
    return call->cubes != NULL ? NAME(process_rows)(call, 8, true, start, request)
                               : NAME(process_rows)(call, 8, false, start, request);
}
