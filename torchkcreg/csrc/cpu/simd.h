// Short vectors of L lanes, and one build for every processor: a kernel is a template over L, compiled for each
// instruction set with the number of lanes that suits it, and picked at run time. Where the compiler lacks vector
// types, L is 1 and a vector is a number.

#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#include "dispatch.h"

#if defined(__GNUC__)
#define TORCHKCREG_LANES 1
#endif

namespace torchkcreg {

template <typename scalar_t, int L>
struct Simd {
#ifdef TORCHKCREG_LANES
  using int_t = std::conditional_t<sizeof(scalar_t) == 4, int32_t, int64_t>;
  typedef scalar_t V __attribute__((vector_size(L * sizeof(scalar_t))));
  typedef int_t I __attribute__((vector_size(L * sizeof(scalar_t))));
  typedef scalar_t Unaligned __attribute__((vector_size(L * sizeof(scalar_t)), aligned(sizeof(scalar_t)), may_alias));

  static TORCHKCREG_INLINE V load(const scalar_t* p) { return *reinterpret_cast<const Unaligned*>(p); }
  static TORCHKCREG_INLINE void store(scalar_t* p, V x) { *reinterpret_cast<Unaligned*>(p) = x; }
  static TORCHKCREG_INLINE V spread(scalar_t x) { return V{} + x; }
  static TORCHKCREG_INLINE I truncate(V x) { return __builtin_convertvector(x, I); }
  static TORCHKCREG_INLINE V number(I x) { return __builtin_convertvector(x, V); }
  static TORCHKCREG_INLINE V smaller(V a, V b) { return a < b ? a : b; }
  static TORCHKCREG_INLINE V larger(V a, V b) { return a > b ? a : b; }
  static TORCHKCREG_INLINE int_t lane(I x, int l) { return x[l]; }
  static TORCHKCREG_INLINE scalar_t lane(V x, int l) { return x[l]; }
  // 0, 1, 2, ...
  static TORCHKCREG_INLINE V ramp() {
    V x;
    for (int l = 0; l < L; ++l) x[l] = scalar_t(l);
    return x;
  }
  // table[i] for indices that all differ from `first` by 0 to reach - 1; reads whole vectors from table + first on.
  static TORCHKCREG_INLINE V lookup(const scalar_t* table, I i, int64_t first, int64_t reach) {
#ifndef __clang__
    if (reach <= 2 * L) {
      const I j = i - static_cast<int_t>(first);
      return __builtin_shuffle(load(table + first), load(table + first + L), j);
    }
    if (reach <= 4 * L) {
      const I j = i - static_cast<int_t>(first);
      const V low = __builtin_shuffle(load(table + first), load(table + first + L), j);
      const V high = __builtin_shuffle(load(table + first + 2 * L), load(table + first + 3 * L), j);
      return j < 2 * L ? low : high;
    }
#endif
    return gather(table, i);
  }
  // Interpolates between table[i] and table[i + 1], with the same conditions, for reach below 2 L.
  static TORCHKCREG_INLINE V between_near(const scalar_t* table, I i, V fraction, int64_t first) {
#ifndef __clang__
    const V low = load(table + first), high = load(table + first + L);
    const I j = i - static_cast<int_t>(first);
    const V a = __builtin_shuffle(low, high, j), b = __builtin_shuffle(low, high, j + 1);
#else
    const V a = gather(table, i), b = gather(table + 1, i);
#endif
    return a + fraction * (b - a);
  }
  static TORCHKCREG_INLINE V gather(const scalar_t* table, I i) {
    V x;
    for (int l = 0; l < L; ++l) x[l] = table[i[l]];
    return x;
  }
  static constexpr int64_t kReadAhead = 4 * L;  // how far beyond the first index `lookup` may read
#else
  static_assert(L == 1, "this compiler has no vector types");
  using int_t = int64_t;
  using V = scalar_t;
  using I = int64_t;
  static TORCHKCREG_INLINE V load(const scalar_t* p) { return *p; }
  static TORCHKCREG_INLINE void store(scalar_t* p, V x) { *p = x; }
  static TORCHKCREG_INLINE V spread(scalar_t x) { return x; }
  static TORCHKCREG_INLINE I truncate(V x) { return static_cast<I>(x); }
  static TORCHKCREG_INLINE V number(I x) { return static_cast<V>(x); }
  static TORCHKCREG_INLINE V smaller(V a, V b) { return a < b ? a : b; }
  static TORCHKCREG_INLINE V larger(V a, V b) { return a > b ? a : b; }
  static TORCHKCREG_INLINE int_t lane(I x, int) { return x; }
  static TORCHKCREG_INLINE scalar_t lane(V x, int) { return x; }
  static TORCHKCREG_INLINE V ramp() { return 0; }
  static TORCHKCREG_INLINE V lookup(const scalar_t* table, I i, int64_t, int64_t) { return table[i]; }
  static TORCHKCREG_INLINE V between_near(const scalar_t* table, I i, V fraction, int64_t) {
    return table[i] + fraction * (table[i + 1] - table[i]);
  }
  static TORCHKCREG_INLINE V gather(const scalar_t* table, I i) { return table[i]; }
  static constexpr int64_t kReadAhead = 4;
#endif
};

TORCHKCREG_INLINE void prefetch(const void* from) {
#ifdef TORCHKCREG_LANES
  __builtin_prefetch(from);
#else
  (void)from;
#endif
}

constexpr int64_t kMaxReadAhead = 64;  // of every vector below

// Defines `name(parameters)`, which calls name##_kernel<scalar_t, L> compiled for the best instruction set at hand.
#if defined(TORCHKCREG_LANES) && defined(__x86_64__) && (defined(__clang__) || __GNUC__ >= 12)
#define TORCHKCREG_BY_PROCESSOR(scalar_t, name, parameters, arguments)                   \
  __attribute__((target("arch=x86-64-v4"), flatten)) inline void name##_512 parameters { \
    name##_kernel<scalar_t, 64 / sizeof(scalar_t)> arguments;                            \
  }                                                                                      \
  __attribute__((target("arch=x86-64-v3"), flatten)) inline void name##_256 parameters { \
    name##_kernel<scalar_t, 32 / sizeof(scalar_t)> arguments;                            \
  }                                                                                      \
  __attribute__((flatten)) inline void name##_128 parameters {                           \
    name##_kernel<scalar_t, 16 / sizeof(scalar_t)> arguments;                            \
  }                                                                                      \
  inline void name parameters {                                                          \
    if (__builtin_cpu_supports("x86-64-v4")) {                                           \
      name##_512 arguments;                                                              \
    } else if (__builtin_cpu_supports("x86-64-v3")) {                                    \
      name##_256 arguments;                                                              \
    } else {                                                                             \
      name##_128 arguments;                                                              \
    }                                                                                    \
  }
#elif defined(TORCHKCREG_LANES)
#define TORCHKCREG_BY_PROCESSOR(scalar_t, name, parameters, arguments) \
  inline void name parameters { name##_kernel<scalar_t, 16 / sizeof(scalar_t)> arguments; }
#else
#define TORCHKCREG_BY_PROCESSOR(scalar_t, name, parameters, arguments) \
  inline void name parameters { name##_kernel<scalar_t, 1> arguments; }
#endif

}  // namespace torchkcreg
