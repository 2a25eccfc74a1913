// Weighted sums of shifted lines, the building block of separable filters.

#pragma once

#include <algorithm>
#include <cstdint>

#include "simd.h"

namespace torchkcreg {

// out[i] = sum_k weight[k] * row[k][i] for i in [0, count): accumulators stay in registers for any number of rows.
template <typename scalar_t, int L, int B, typename Row>
TORCHKCREG_INLINE void weigh_block(int64_t rows, const scalar_t* weight, const Row& row, int64_t i, scalar_t* out) {
  using S = Simd<scalar_t, L>;
  typename S::V sum[B];
  for (int b = 0; b < B; ++b) sum[b] = S::spread(0);
  for (int64_t k = 0; k < rows; ++k) {
    const scalar_t* from = row(k) + i;
    for (int b = 0; b < B; ++b) sum[b] += S::load(from + b * L) * weight[k];
  }
  for (int b = 0; b < B; ++b) S::store(out + i + b * L, sum[b]);
}

template <typename scalar_t, int L, typename Row>
TORCHKCREG_INLINE void weigh_lines(int64_t rows, const scalar_t* weight, const Row& row, int64_t count, scalar_t* out) {
  int64_t i = 0;
  for (; i + 4 * L <= count; i += 4 * L) weigh_block<scalar_t, L, 4>(rows, weight, row, i, out);
  for (; i + L <= count; i += L) weigh_block<scalar_t, L, 1>(rows, weight, row, i, out);
  for (; i < count; ++i) {
    scalar_t sum = 0;
    for (int64_t k = 0; k < rows; ++k) sum += row(k)[i] * weight[k];
    out[i] = sum;
  }
}

}  // namespace torchkcreg
