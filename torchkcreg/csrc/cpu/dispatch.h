// One build for all processors of an architecture: hot functions are compiled once per instruction set, and the loader
// selects one. Callees are inlined (flatten), so templates called by a marked function need no mark themselves.

#pragma once

#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#if __GNUC__ >= 12
#define TORCHKCREG_MULTIVERSION __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default"), flatten))
#else  // these compilers do not know the names of x86-64 levels
#define TORCHKCREG_MULTIVERSION __attribute__((target_clones("avx512f", "avx2", "default"), flatten))
#endif
#else
#define TORCHKCREG_MULTIVERSION
#endif

#if defined(__GNUC__)
#define TORCHKCREG_INLINE inline __attribute__((always_inline))
#define TORCHKCREG_RESTRICT __restrict__
#else
#define TORCHKCREG_INLINE inline
#define TORCHKCREG_RESTRICT __restrict
#endif

#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define TORCHKCREG_VECTOR_EXTENSIONS 1
#endif
#endif
