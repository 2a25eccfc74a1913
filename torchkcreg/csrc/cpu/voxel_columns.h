// The inner loops along z, where values lie next to each other: linear interpolation at equal steps, and its adjoint.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "simd.h"

namespace torchkcreg {
namespace {

constexpr int64_t kColumnPad = 16;  // elements before index 0 of a padded column; one would do, the rest is alignment

// Elements that a padded column of count needs, from its very start.
inline int64_t padded_size(int64_t count) { return kColumnPad + count + 2 + kMaxReadAhead; }

// Elements that the samples of gather_resampled need; it may read that many again past their end.
inline int64_t padded_samples(int64_t count) { return 2 * count + 2 + kMaxReadAhead; }

// Elements [begin, end).
struct Range {
  int64_t begin, end;
};

// The range widened to whole vectors, as far as count allows.
template <int L>
TORCHKCREG_INLINE Range whole_vectors(Range range, int64_t count) {
  return {range.begin / L * L, std::min((range.end + L - 1) / L * L, count)};
}

// The n in [0, count) with start + n * step between low and high, give or take one; step > 0.
TORCHKCREG_INLINE Range steps_between(double start, double step, double low, double high, int64_t count) {
  const double n = double(count);
  const double a = std::min(std::max((low - start) / step, 0.0), n);
  const double b = std::min(std::max((high - start) / step, -1.0), n);
  return {static_cast<int64_t>(a), std::min(static_cast<int64_t>(b + 1), count)};
}

// sums[n] += column(start + n * step) for n in range, linear between elements, which number `count`; step > 0.
// column points at element 0 and is padded with zeros. Sums may be touched up to a vector before and beyond the range.
template <typename scalar_t, int L>
TORCHKCREG_INLINE void add_resampled(const scalar_t* TORCHKCREG_RESTRICT column, int64_t count, double start,
                                     double step, Range range, scalar_t* TORCHKCREG_RESTRICT sums) {
  using S = Simd<scalar_t, L>;
  const scalar_t* before = column - 1;  // positions count from the element before, so that truncation is floor
  const typename S::V low = S::spread(0), high = S::spread(scalar_t(count + 1));
  const typename S::V ramp = S::ramp() * scalar_t(step) + scalar_t(start + 1);
  const int64_t reach = static_cast<int64_t>(step * (L - 1)) + 3;
  for (int64_t n = range.begin / L * L; n < range.end; n += L) {
    const typename S::V position = S::smaller(S::larger(ramp + scalar_t(step) * scalar_t(n), low), high);
    const typename S::I below = S::truncate(position);
    const typename S::V fraction = position - S::number(below);
    const int64_t first = S::lane(below, 0);
    typename S::V value;
    if (reach < 2 * L) {
      value = S::between_near(before, below, fraction, first);
    } else {
      const typename S::V a = S::lookup(before, below, first, reach);
      value = a + fraction * (S::lookup(before + 1, below, first, reach) - a);
    }
    S::store(sums + n, S::load(sums + n) + value);
  }
}

// The adjoint: sums[k] = sum over n of samples[n] * max(0, 1 - |start + n * step - k|) for k in range, n in [0, count).
// samples is padded with zeros. Sums may be written up to a vector before and beyond the range.
template <typename scalar_t, int L>
TORCHKCREG_INLINE void gather_resampled(const scalar_t* TORCHKCREG_RESTRICT samples, int64_t count, double start,
                                        double step, Range range, scalar_t* TORCHKCREG_RESTRICT sums) {
  using S = Simd<scalar_t, L>;
  const double inverse = 1 / step;
  const int64_t taps = static_cast<int64_t>(std::min(2 * inverse, double(count))) + 1;
  const int64_t reach = static_cast<int64_t>((L - 1) * inverse) + 2;
  const typename S::V low = S::spread(0), high = S::spread(scalar_t(count)), one = S::spread(1);
  // One more than the last sample at or below k - 1, i.e. the first sample that contributes to k.
  const typename S::V ramp = S::ramp() * scalar_t(inverse) + scalar_t((-1 - start) * inverse + 1);
  for (int64_t k = range.begin / L * L; k < range.end; k += L) {
    const typename S::V edge = S::smaller(S::larger(ramp + scalar_t(inverse) * scalar_t(k), low), high);
    const typename S::I n = S::truncate(edge);
    typename S::V offset = S::number(n) * scalar_t(step) + (scalar_t(start) - (S::ramp() + scalar_t(k)));
    const int64_t first = S::lane(n, 0);
    typename S::V sum = S::spread(0);
    for (int64_t tap = 0; tap < taps; ++tap) {
      const typename S::V weight = S::larger(S::smaller(one + offset, one - offset), low);
      sum += weight * S::lookup(samples + tap, n, first, reach);
      offset += scalar_t(step);
    }
    S::store(sums + k, sum);
  }
}

// sums = a * x + b * y over [begin, end) and up to a vector more.
template <typename scalar_t, int L>
TORCHKCREG_INLINE void blend(const scalar_t* TORCHKCREG_RESTRICT x, scalar_t a, const scalar_t* TORCHKCREG_RESTRICT y,
                             scalar_t b, Range range, scalar_t* TORCHKCREG_RESTRICT sums) {
  using S = Simd<scalar_t, L>;
  int64_t k = range.begin;
  for (; k + L <= range.end; k += L) S::store(sums + k, a * S::load(x + k) + b * S::load(y + k));
  for (; k < range.end; ++k) sums[k] = a * x[k] + b * y[k];
}

// sums += a * x over the range.
template <typename scalar_t, int L>
TORCHKCREG_INLINE void add_scaled(const scalar_t* TORCHKCREG_RESTRICT x, scalar_t a, Range range,
                                  scalar_t* TORCHKCREG_RESTRICT sums) {
  using S = Simd<scalar_t, L>;
  int64_t k = range.begin;
  for (; k + L <= range.end; k += L) S::store(sums + k, S::load(sums + k) + a * S::load(x + k));
  for (; k < range.end; ++k) sums[k] += a * x[k];
}

}  // namespace
}  // namespace torchkcreg
