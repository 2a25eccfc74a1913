// exp(x) of short vectors, accurate to the last bits: 2^n exp(r) with |r| <= ln(2) / 2 and a polynomial for exp(r).

#pragma once

#include <cmath>
#include <cstring>

#include "simd.h"

namespace torchkcreg {

#ifdef TORCHKCREG_LANES
template <typename scalar_t, int L>
TORCHKCREG_INLINE typename Simd<scalar_t, L>::V exponential(typename Simd<scalar_t, L>::V x) {
  using S = Simd<scalar_t, L>;
  constexpr bool single = sizeof(scalar_t) == 4;
  // Outside this range the result is not a normal number; below it, it is practically 0. This order preserves NaN.
  x = S::smaller(S::spread(single ? 88.0 : 709.0), S::larger(S::spread(single ? -87.0 : -708.0), x));
  const typename S::V scaled = x * scalar_t(1.4426950408889634);
  const typename S::I n = S::truncate(scaled + (scaled < 0 ? S::spread(-0.5) : S::spread(0.5)));
  const typename S::V whole = S::number(n);
  // ln(2) in two parts; the first has few bits, so that its multiples are exact
  typename S::V r = x - whole * scalar_t(single ? 0.693359375 : 6.93145751953125e-1);
  r -= whole * scalar_t(single ? -2.12194440e-4 : 1.42860682030941723212e-6);
  typename S::V y;
  if (single) {  // coefficients of Cephes' expf (Moshier 1989)
    y = S::spread(1.9875691500e-4);
    for (const double c : {1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1}) {
      y = y * r + scalar_t(c);
    }
    y = y * r * r + r + scalar_t(1);
  } else {  // Taylor's series, 13 terms
    y = S::spread(1.0 / 13);
    for (int k = 12; k >= 1; --k) y = (y * r + scalar_t(1)) * scalar_t(1.0 / k);
    y = y * r + scalar_t(1);
  }
  const typename S::I bits = (n + (single ? 127 : 1023)) << (single ? 23 : 52);
  typename S::V power;
  std::memcpy(&power, &bits, sizeof(power));
  return y * power;
}
#else
template <typename scalar_t, int L>
TORCHKCREG_INLINE scalar_t exponential(scalar_t x) {
  return std::exp(x);
}
#endif

}  // namespace torchkcreg
