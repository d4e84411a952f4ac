// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* The functions of cube_scan.h as a process, for test/core/test_kernel.py: it reads calls from standard
 * input and writes their results to standard output, as long as there are calls.
 *
 * A call is the number of the function (0 cube_scan, 1 cube_filter), start and n_residuals (int64_t
 * each), and for each array its number of bytes (-1: none), its number of axes, their lengths, and its
 * bytes. The answer is the row and the request, and the bytes of the arrays that are written.
 * Every array has exactly its size, so that sanitizers see each byte beyond. */
#include "cube_scan.h"

#include <stdio.h>
#include <stdlib.h>

static int64_t read_number(void) {
    int64_t number;
    if (fread(&number, sizeof number, 1, stdin) != 1)
        exit(feof(stdin) ? 0 : 1);
    return number;
}

/* Reads one array into the call. Returns its memory, or NULL if there is none. */
static void *read_array(const cube_scan_array *array, void *call, int64_t *length, size_t *size) {
    const int64_t n_bytes = read_number(), n_axes = read_number();
    int64_t shape[3];
    for (int64_t axis = 0; axis < n_axes; axis++)
        shape[axis] = read_number();
    if (n_bytes < 0)
        return NULL;
    *size = (size_t)n_bytes;
    void *memory = malloc(*size + (*size == 0));
    if (memory == NULL || fread(memory, 1, *size, stdin) != *size ||
        !cube_scan_set(array, call, length, memory, shape, (size_t)n_axes))
        exit(1);
    return memory;
}

int main(void) {
    for (;;) {
        const bool is_scan = read_number() == 0;
        int64_t request = 0, row = read_number();
        cube_scan_call scan = cube_scan_begin();
        cube_filter_call filter = cube_filter_begin();
        scan.n_residuals = read_number();
        const cube_scan_array *arrays = is_scan ? cube_scan_arrays : cube_filter_arrays;
        const size_t n_arrays = is_scan ? CUBE_SCAN_N_ARRAYS : CUBE_FILTER_N_ARRAYS;
        void *memory[CUBE_SCAN_N_ARRAYS] = {0};
        size_t sizes[CUBE_SCAN_N_ARRAYS] = {0};
        for (size_t i = 0; i < n_arrays; i++)
            memory[i] = is_scan ? read_array(&arrays[i], &scan, scan.length, &sizes[i])
                                : read_array(&arrays[i], &filter, filter.length, &sizes[i]);
        if (is_scan)
            row = cube_scan(&scan, row, &request);
        else
            cube_filter(&filter);
        fwrite(&row, sizeof row, 1, stdout);
        fwrite(&request, sizeof request, 1, stdout);
        for (size_t i = 0; i < n_arrays; i++) {
            if (arrays[i].use >= CUBE_SCAN_STATE && memory[i] != NULL)
                fwrite(memory[i], 1, sizes[i], stdout);
            free(memory[i]);
        }
        fflush(stdout);
    }
}
