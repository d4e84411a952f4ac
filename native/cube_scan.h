/* The rows of a scan: from frequencies of pads to stress, status and the sums of health windows.
 *
 * One row is one sample of one cube, one scan at most one row of each cube. `cube_scan` works on a
 * row from beginning to end before it goes to the next one. The readable specification in numpy is
 * cube_tensor_driver/core/kernel/rows.py; tests hold both equal to the bit.
 *
 * The same bits on every processor: each operation is one of + - * / sqrt, which IEEE 754 rounds
 * correctly; the terms of a sum are added in a fixed order; and the file is compiled with
 * -ffp-contract=off, so that no product and sum are rounded together. Vector instructions compute
 * several pads, or several outputs, of one row side by side, which changes no order.
 *
 * Memory of a scan of 1264 planar cubes (8 pads), float32: state of health 0.64 MB, pad law 0.08 MB,
 * frequencies and results 0.14 MB, one matrix of 512 bytes for each calibration (0.65 MB if all
 * differ). The sum of 0.8 to 1.5 MB is to stay in the L2 cache. Each byte is used once per scan, in
 * the order of the rows, so that the processor fetches what lies in a slower cache in advance.
 *
 * No heap, no system, no state of its own. */
#ifndef CUBE_SCAN_H
#define CUBE_SCAN_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define CUBE_SCAN_MAX_PADS 32    /* pads of a cube; bit p of a mask stands for pad p */
#define CUBE_SCAN_BLOCK 16       /* outputs computed side by side; rows of matrices are padded to it */
#define CUBE_SCAN_MAX_OUTPUTS 48 /* 15 components and at most 32 residuals, padded */
#define CUBE_SCAN_COMPONENTS 15
#define CUBE_SCAN_STRESS 6
#define CUBE_SCAN_QUANTITIES 13 /* of a pad in the state of health */

/* What `cube_scan` asks of its caller when it returns before the last row; else the sum of the
 * number of a calibration times 2^32 and a mask of bad pads, whose matrix is missing. */
#define CUBE_SCAN_DONE (-1)
#define CUBE_SCAN_WINDOW (-2)       /* the next scan is outside the window of health */
#define CUBE_SCAN_UNKNOWN_CUBE (-3) /* health was asked for a cube that the skin does not have */

/* State of health of one cube; core/kernel/contract.py has the same layout as CUBE_STATE. */
typedef struct {
    int64_t time_ns, interval_ns;          /* newest stamp, and the time between the newest two */
    int64_t gap_before_ns, gap_within_ns;  /* of the window */
    int64_t rows, over_limit;              /* of the window */
    uint32_t mask;                         /* pads that are not used */
    float temperature;                     /* newest, in degrees Celsius */
    uint16_t status;                       /* conditions of all pads */
    uint16_t is_doubtful;                  /* the newest stamp */
} cube_state;

/* Arrays and lengths of one call. Arrays are row-major; "real" is float or double. Masks and status
 * bits have the values of core/status.py. */
typedef struct {
    bool is_double; /* whether real is double */
    int64_t n_rows, n_cubes, n_pads, n_calibrations, n_degrees, n_tables, n_extra, n_outputs;
    int64_t n_quantities;
    int64_t n_residuals; /* outputs 15 to 15 + n_residuals - 1 are residuals */

    /* Tables of the skin. */
    const int32_t *calibration;  /* (cubes) number of the cube's calibration */
    const int32_t *pads;         /* (calibrations) number of pads */
    const void *rest, *highest;  /* (cubes, pads) real: f0 and f0 (1 + beta) / beta, in Hz */
    const double *reference;     /* (calibrations) reference temperature; NaN: no model */
    const double *coefficients;  /* (calibrations, degrees, pads) of the temperature model */
    const void *matrix, *limit;  /* (tables, pads, outputs), (tables) real */
    const uint16_t *observed;    /* (tables) components that are known */
    const int64_t *keys;         /* (extra) rising: calibration * 2^32 + mask of bad pads */
    const int32_t *numbers;      /* (extra) number of the table of each key */

    /* State of health; all are NULL where health is not asked for. */
    cube_state *cubes;   /* (cubes) */
    void *quantities;    /* (cubes, 13, pads) float, in the order of `enum quantity` */
    uint16_t *found;     /* (cubes, pads) conditions found in this window */
    int64_t *window_ns;  /* begin and end of the window, newest stamp of the last scan */

    /* Rows. */
    const uint16_t *cube;
    const void *frequency; /* (rows, pads) real, in Hz */
    const float *temperature;
    const uint32_t *pad_fault;
    const int64_t *stamp_ns;
    const uint16_t *doubt;  /* STAMP, if the stamp is doubtful */
    const bool *known;      /* NULL, or: left_out and status hold the health of this row already */

    /* Results; left_out and status also are inputs where health is not asked for. */
    void *stress, *gradient, *residual; /* (rows, 6), (rows, 9), (rows) real */
    uint16_t *status, *row_observed;
    uint32_t *left_out;
} cube_scan_call;

/* Array of a call: its place in cube_scan_call, and what a caller has to check.
 *
 * kind: of numpy, 'f', 'i', 'u', 'b' or 'V'; 'R' is float or double.
 * size: bytes of a value; 0 for real.
 * shape: one letter for the length of each axis (see `cube_scan_lengths`).
 * is_result: whether it is written. is_health: whether it may be missing. */
typedef struct {
    const char *name;
    size_t offset;
    char kind;
    size_t size;
    const char *shape;
    bool is_result, may_be_none;
} cube_scan_array;

extern const cube_scan_array cube_scan_arrays[];
extern const size_t cube_scan_n_arrays;

/* Returns the length in a call that a letter of `shape` stands for. */
int64_t *cube_scan_length(cube_scan_call *call, char letter);

/* Prepares a call: no array, and all lengths unknown (-1) but that of `Q`. */
void cube_scan_begin(cube_scan_call *call);

/* Returns whether the lengths of a call suit the kernel, and all or no arrays of health are there.
 * The numbers in `calibration`, `pads` and `numbers` are the caller's duty. */
bool cube_scan_fits(const cube_scan_call *call, int64_t start);

/* Processes rows from `start` on. Returns the first row that is not processed; `*request` states
 * what the caller has to do before it calls again from there. */
int64_t cube_scan(const cube_scan_call *call, int64_t start, int64_t *request);

#endif
