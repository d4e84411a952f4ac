// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Vector instructions, for functions that compute several numbers side by side.
 *
 * On x86, GCC also compiles versions of a function with the vector instructions of AVX-512 and AVX2.
 * The loader chooses the best one that the processor has. All give the same bits.
 * LANES tells the compiler that the iterations of the next loop are independent of each other. */
#ifndef CUBE_VECTOR_H
#define CUBE_VECTOR_H

#if defined(__GNUC__) && !defined(__clang__)
#define INLINE static inline __attribute__((always_inline))
#define LANES _Pragma("GCC ivdep") _Pragma("GCC unroll 1")
#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__SANITIZE_ADDRESS__)
#define CLONES __attribute__((target_clones("avx512f", "avx2", "default")))
#endif
#else
#define INLINE static inline
#define LANES
#endif
#ifndef CLONES
#define CLONES
#endif

#endif
