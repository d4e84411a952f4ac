#include "cube_scan.h"

#include <math.h>
#include <string.h>

/* The compiler makes a version for vector instructions of AVX2, and the loader chooses one. Both
 * give the same bits, because neither changes the order of operations. */
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__)
#define CLONES __attribute__((target_clones("avx2", "default")))
#else
#define CLONES
#endif

#ifdef __GNUC__
#define INLINE static inline __attribute__((always_inline))
#define LANES _Pragma("GCC ivdep") _Pragma("GCC unroll 1")
#define UNROLL _Pragma("GCC unroll 8")
#else
#define INLINE static inline
#define LANES
#define UNROLL
#endif

#define ROWS 32            /* rows of a block */
#define UNKNOWN_TABLE (-1) /* of a row whose cube the skin does not have */

/* Bits of core/status.py. */
enum {
    PAD_FAULT = 1,
    RESIDUAL = 2,
    INVALID = 4,
    TEMPERATURE = 8,
    OPEN = 16,
    SHORT = 32,
    RANGE = 64,
    REPORTED = 512,
    STAMP = 2048,
};

/* Quantities of each pad in the order of PAD_STATE in core/kernel/contract.py. */
enum quantity {
    LAST,
    DIFFERENCE,
    FIRST_SQUARES,
    SECOND_SQUARES,
    BOUNDED_SQUARES,
    SUM,
    LOWEST,
    HIGHEST,
    BASE,
    BOUND,
    LOW,
    HIGH,
    OPEN_FROM,
    QUANTITIES,
};


_Static_assert(sizeof(cube_state) == 8 * 8, "the length in cube_scan_arrays");

static const int64_t GAP_NS = 50000000;
static const double MAX_JITTER_RATIO = 1.5;

INLINE uint32_t mask_of(int32_t pads) {
    return pads >= 32 ? UINT32_MAX : (UINT32_C(1) << pads) - 1;
}

/* Returns the number of the table of a key, by bisection; -1 if there is none. */
INLINE int32_t find_table(const cube_scan_call *call, int64_t key) {
    int64_t low = 0, high = call->n_extra;
    while (low < high) {
        const int64_t middle = (low + high) / 2;
        if (call->keys[middle] < key)
            low = middle + 1;
        else
            high = middle;
    }
    return low < call->n_extra && call->keys[low] == key ? call->numbers[low] : -1;
}

/* Returns whether the newest stamp of a scan lies in the window. A scan begins where the cube
 * number does not rise; other rows belong to a scan that was asked about already. */
INLINE bool is_in_window(const cube_scan_call *call, int64_t row) {
    if (row > 0 && call->cube[row] > call->cube[row - 1])
        return true;
    int64_t newest_ns = call->stamp_ns[row];
    for (int64_t i = row + 1; i < call->n_rows && call->cube[i] > call->cube[i - 1]; i++)
        newest_ns = call->stamp_ns[i] > newest_ns ? call->stamp_ns[i] : newest_ns;
    call->window_ns[2] = newest_ns;
    return call->window_ns[0] <= newest_ns && newest_ns < call->window_ns[1];
}

INLINE uint64_t magnitude(int64_t value) {
    return value < 0 ? 0 - (uint64_t)value : (uint64_t)value;
}

/* Ratio r and weight w of a second difference, from the last two intervals between rows:
 *
 *     r = interval / interval before,   w = 6 / (1 + (1 + r)^2 + r^2)
 *
 * r = 1 if both are equal up to jitter. w = 0 if an interval is a gap, or a stamp doubtful. */
INLINE void measure_pace(
    cube_state *state, int64_t stamp_ns, bool is_doubtful, float *ratio, float *weight) {
    const int64_t between = (int64_t)((uint64_t)stamp_ns - (uint64_t)state->time_ns);
    const int64_t before = state->interval_ns;
    const int64_t now = is_doubtful || state->is_doubtful != 0 ? 0 : between;
    state->time_ns = stamp_ns;
    state->interval_ns = now;
    state->is_doubtful = is_doubtful;

    if (between < 0 || between >= GAP_NS) {
        if (state->rows == 0)
            state->gap_before_ns = between;
        else if (magnitude(between) > magnitude(state->gap_within_ns))
            state->gap_within_ns = between;
    }
    const int64_t shorter = now < before ? now : before, longer = now < before ? before : now;
    const bool is_known = shorter > 0 && longer < GAP_NS;
    const bool is_even = (double)longer < MAX_JITTER_RATIO * (double)shorter;
    *ratio = 1;
    *weight = is_known ? 1 : 0;
    if (is_known && !is_even) {
        const double r = (double)now / (double)before;
        *ratio = (float)r;
        *weight = (float)(6 / (1 + (1 + r) * (1 + r) + r * r));
    }
}

#define REAL float
#define NAME(x) x##_float
#define ROOT sqrtf
#include "cube_scan_rows.h"
#undef REAL
#undef NAME
#undef ROOT
#define REAL double
#define NAME(x) x##_double
#define ROOT sqrt
#include "cube_scan_rows.h"

int64_t cube_scan(const cube_scan_call *call, int64_t start, int64_t *request) {
    /* A call with a cube that the skin does not have is refused before it changes any state. */
    bool is_unknown = false;
    for (int64_t row = start; call->cubes != NULL && row < call->n_rows; row++)
        is_unknown |= call->cube[row] >= call->n_cubes;
    if (is_unknown) {
        *request = CUBE_SCAN_UNKNOWN_CUBE;
        return start;
    }
    return (call->is_double ? process_double : process_float)(call, start, request);
}

/* ------------------------------------------------------------------------------ arrays -------- */

/* Letters: N rows, C cubes, P pads, G calibrations, D degrees, T tables, E extra tables, K outputs,
 * Q quantities; digits stand for themselves. */
int64_t *cube_scan_length(cube_scan_call *call, char letter) {
    switch (letter) {
    case 'N': return &call->n_rows;
    case 'C': return &call->n_cubes;
    case 'P': return &call->n_pads;
    case 'G': return &call->n_calibrations;
    case 'D': return &call->n_degrees;
    case 'T': return &call->n_tables;
    case 'E': return &call->n_extra;
    case 'K': return &call->n_outputs;
    case 'Q': return &call->n_quantities;
    default: return NULL;
    }
}

void cube_scan_begin(cube_scan_call *call) {
    *call = (cube_scan_call){.n_quantities = QUANTITIES};
    for (const char *letter = "NCPGDTEK"; *letter != '\0'; letter++)
        *cube_scan_length(call, *letter) = -1;
}

bool cube_scan_fits(const cube_scan_call *call, int64_t start) {
    const bool has_health = call->cubes != NULL;
    return start >= 0 && call->n_pads <= CUBE_SCAN_MAX_PADS &&
           call->n_outputs % CUBE_SCAN_BLOCK == 0 && call->n_outputs <= CUBE_SCAN_MAX_OUTPUTS &&
           call->n_residuals >= 0 &&
           call->n_residuals <= call->n_outputs - CUBE_SCAN_COMPONENTS &&
           (call->quantities != NULL) == has_health && (call->found != NULL) == has_health &&
           (call->window_ns != NULL) == has_health;
}

#define ARRAY(name, kind, size, shape, is_result, may_be_none) \
    {#name, offsetof(cube_scan_call, name), kind, size, shape, is_result, may_be_none}
const cube_scan_array cube_scan_arrays[] = {
    ARRAY(calibration, 'i', 4, "C", false, false),
    ARRAY(pads, 'i', 4, "G", false, false),
    ARRAY(rest, 'R', 0, "CP", false, false),
    ARRAY(highest, 'R', 0, "CP", false, false),
    ARRAY(reference, 'f', 8, "G", false, false),
    ARRAY(coefficients, 'f', 8, "GDP", false, false),
    ARRAY(matrix, 'R', 0, "TPK", false, false),
    ARRAY(limit, 'R', 0, "T", false, false),
    ARRAY(observed, 'u', 2, "T", false, false),
    ARRAY(keys, 'i', 8, "E", false, false),
    ARRAY(numbers, 'i', 4, "E", false, false),
    ARRAY(cubes, 'i', 8, "C8", true, true), /* 8 words of 8 bytes are a cube_state */
    ARRAY(quantities, 'f', 4, "CQP", true, true),
    ARRAY(found, 'u', 2, "CP", true, true),
    ARRAY(window_ns, 'i', 8, "3", true, true),
    ARRAY(cube, 'u', 2, "N", false, false),
    ARRAY(frequency, 'R', 0, "NP", false, false),
    ARRAY(temperature, 'f', 4, "N", false, false),
    ARRAY(pad_fault, 'u', 4, "N", false, false),
    ARRAY(stamp_ns, 'i', 8, "N", false, false),
    ARRAY(doubt, 'u', 2, "N", false, false),
    ARRAY(known, 'b', 1, "N", false, true),
    ARRAY(stress, 'R', 0, "N6", true, false),
    ARRAY(gradient, 'R', 0, "N9", true, false),
    ARRAY(residual, 'R', 0, "N", true, false),
    ARRAY(status, 'u', 2, "N", true, false),
    ARRAY(row_observed, 'u', 2, "N", true, false),
    ARRAY(left_out, 'u', 4, "N", true, false),
};
const size_t cube_scan_n_arrays = sizeof cube_scan_arrays / sizeof *cube_scan_arrays;
