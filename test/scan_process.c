// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* The kernel of a scan as a process, for test/core/test_kernel.py: it reads calls from standard input
 * and writes their results to standard output, as long as there are calls.
 *
 * A call is start and n_residuals (int64_t each), and for each array its number of bytes (-1: none),
 * its number of axes, their lengths, and its bytes. The answer is the row and the request, and the
 * bytes of the arrays that are written.
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

int main(void) {
    for (;;) {
        int64_t request, row = read_number();
        cube_scan_call call = cube_scan_begin();
        call.n_residuals = read_number();
        void *memory[CUBE_SCAN_N_ARRAYS] = {0};
        size_t sizes[CUBE_SCAN_N_ARRAYS] = {0};
        for (size_t i = 0; i < CUBE_SCAN_N_ARRAYS; i++) {
            const int64_t size = read_number(), n_axes = read_number();
            int64_t shape[3];
            for (int64_t axis = 0; axis < n_axes; axis++)
                shape[axis] = read_number();
            if (size < 0)
                continue;
            sizes[i] = (size_t)size;
            memory[i] = malloc(sizes[i] + (size == 0));
            if (memory[i] == NULL || fread(memory[i], 1, sizes[i], stdin) != sizes[i] ||
                !cube_scan_set(
                    &cube_scan_arrays[i], &call, call.length, memory[i], shape, (size_t)n_axes))
                return 1;
        }
        row = cube_scan(&call, row, &request);
        fwrite(&row, sizeof row, 1, stdout);
        fwrite(&request, sizeof request, 1, stdout);
        for (size_t i = 0; i < CUBE_SCAN_N_ARRAYS; i++) {
            if (cube_scan_arrays[i].use >= CUBE_SCAN_STATE && memory[i] != NULL)
                fwrite(memory[i], 1, sizes[i], stdout);
            free(memory[i]);
        }
        fflush(stdout);
    }
}
