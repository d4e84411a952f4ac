/* The kernel of a scan as a process, for test/core/test_kernel.py: it reads calls from standard input
 * and writes their results to standard output, as long as there are calls.
 *
 * A call is start, n_residuals, is_double (int64_t each), and for each array its number of bytes
 * (-1: none), its shape (3 int64_t, 1 for axes that it does not have), and its bytes. The answer is
 * the row and the request, and the bytes of the arrays that are written.
 * Every array has exactly its size, so that sanitizers see each byte beyond. */
#include "cube_scan.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int64_t read_number(void) {
    int64_t number;
    if (fread(&number, sizeof number, 1, stdin) != 1)
        exit(feof(stdin) ? 0 : 1);
    return number;
}

int main(void) {
    for (;;) {
        const int64_t start = read_number();
        cube_scan_call call;
        cube_scan_begin(&call);
        call.n_residuals = read_number();
        call.is_double = read_number() != 0;
        void *memory[64] = {0};
        size_t sizes[64] = {0};
        for (size_t i = 0; i < cube_scan_n_arrays; i++) {
            const cube_scan_array *array = &cube_scan_arrays[i];
            const int64_t size = read_number();
            for (size_t axis = 0; axis < 3; axis++) {
                const int64_t length = read_number();
                if (size >= 0 && axis < strlen(array->shape) &&
                    cube_scan_length(&call, array->shape[axis]) != NULL)
                    *cube_scan_length(&call, array->shape[axis]) = length;
            }
            if (size < 0)
                continue;
            sizes[i] = (size_t)size;
            memory[i] = malloc(sizes[i] + (size == 0));
            if (memory[i] == NULL || fread(memory[i], 1, sizes[i], stdin) != sizes[i])
                return 1;
            memcpy((char *)&call + array->offset, &memory[i], sizeof memory[i]);
        }
        if (!cube_scan_fits(&call, start))
            return 1;
        int64_t request;
        const int64_t row = cube_scan(&call, start, &request);
        fwrite(&row, sizeof row, 1, stdout);
        fwrite(&request, sizeof request, 1, stdout);
        for (size_t i = 0; i < cube_scan_n_arrays; i++) {
            if (cube_scan_arrays[i].is_result && memory[i] != NULL)
                fwrite(memory[i], 1, sizes[i], stdout);
            free(memory[i]);
        }
        fflush(stdout);
    }
}
