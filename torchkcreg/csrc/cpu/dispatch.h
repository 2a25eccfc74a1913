// One build for every processor of an architecture: hot functions are compiled once per instruction set, and the loader
// picks. Inlined callees are compiled along (flatten), so templates below a marked function need no mark of their own.

#pragma once

#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#if __GNUC__ >= 12
#define TORCHKCREG_MULTIVERSION __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default"), flatten))
#else  // the names of whole levels are newer than these compilers
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
