// The transmitted signal of one image, and its gradient: exponentials, blur along rows and columns, averaging.

#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "exponential.h"
#include "simd.h"

namespace torchkcreg {

constexpr int64_t kPixelsPerSum = 4096;  // summed in scalar_t; these sums are then added in double

struct TransmissionShape {
  int64_t candidates, materials, views, rows, cols, energies, taps, pooling;
};

template <typename scalar_t>
struct TransmissionImage {
  const scalar_t* lengths;  // of the first material
  int64_t next_material;    // offset to the lengths of the next material
  const scalar_t *attenuation, *weights, *kernel;
};

template <typename scalar_t>
struct ImageGradients {
  scalar_t* lengths;
  int64_t next_material;
  double* attenuation;  // null if not needed
  scalar_t* weights;
  double* kernel;
};

template <typename scalar_t>
struct TransmissionScratch {
  std::vector<scalar_t> signal, along_rows, blurred, line;

  explicit TransmissionScratch(const TransmissionShape& p)
      : signal(p.rows * p.cols + kMaxReadAhead),
        along_rows(p.rows * p.cols + kMaxReadAhead),
        blurred(p.rows * p.cols + kMaxReadAhead),
        line(p.cols + p.taps + kMaxReadAhead) {}
};

// Calls `work(p, lanes)` for vectors of L pixels; the last one may have fewer.
template <int L, typename Work>
TORCHKCREG_INLINE void over_pixels(int64_t count, const Work& work) {
  for (int64_t p = 0; p < count; p += L) work(p, std::min<int64_t>(L, count - p));
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE typename Simd<scalar_t, L>::V load_some(const scalar_t* from, int64_t lanes) {
  if (lanes == L) return Simd<scalar_t, L>::load(from);
  alignas(64) scalar_t some[L] = {};
  std::copy(from, from + lanes, some);
  return Simd<scalar_t, L>::load(some);
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void store_some(scalar_t* to, typename Simd<scalar_t, L>::V x, int64_t lanes) {
  if (lanes == L) return Simd<scalar_t, L>::store(to, x);
  alignas(64) scalar_t some[L];
  Simd<scalar_t, L>::store(some, x);
  std::copy(some, some + lanes, to);
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE typename Simd<scalar_t, L>::V passed(const TransmissionShape& p,
                                                       const TransmissionImage<scalar_t>& in, int64_t energy,
                                                       int64_t pixel, int64_t lanes) {
  using S = Simd<scalar_t, L>;
  typename S::V exponent = S::spread(0);
  for (int64_t m = 0; m < p.materials; ++m) {
    const typename S::V length = load_some<scalar_t, L>(in.lengths + m * in.next_material + pixel, lanes);
    exponent -= length * in.attenuation[m * p.energies + energy];
  }
  return exponential<scalar_t, L>(exponent);
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void add_energies(const TransmissionShape& p, const TransmissionImage<scalar_t>& in,
                                    scalar_t* signal) {
  using S = Simd<scalar_t, L>;
  over_pixels<L>(p.rows * p.cols, [&](int64_t pixel, int64_t lanes) {
    typename S::V sum = S::spread(0);
    for (int64_t e = 0; e < p.energies; ++e) sum += passed<scalar_t, L>(p, in, e, pixel, lanes) * in.weights[e];
    store_some<scalar_t, L>(signal + pixel, sum, lanes);
  });
}

// y += scale x
template <typename scalar_t, int L>
TORCHKCREG_INLINE void add_scaled(scalar_t* y, const scalar_t* x, scalar_t scale, int64_t count) {
  over_pixels<L>(count, [&](int64_t i, int64_t lanes) {
    store_some<scalar_t, L>(y + i, load_some<scalar_t, L>(y + i, lanes) + load_some<scalar_t, L>(x + i, lanes) * scale,
                            lanes);
  });
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE double total(typename Simd<scalar_t, L>::V x) {
  alignas(64) scalar_t some[L];
  Simd<scalar_t, L>::store(some, x);
  double sum = 0;
  for (int l = 0; l < L; ++l) sum += some[l];
  return sum;
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE double dot(const scalar_t* x, const scalar_t* y, int64_t count) {
  using S = Simd<scalar_t, L>;
  typename S::V sum = S::spread(0);
  over_pixels<L>(count, [&](int64_t i, int64_t lanes) {
    sum += load_some<scalar_t, L>(x + i, lanes) * load_some<scalar_t, L>(y + i, lanes);
  });
  return total<scalar_t, L>(sum);
}

inline int64_t clamped(int64_t i, int64_t count) { return std::min(std::max<int64_t>(i, 0), count - 1); }

// Correlates along the first dimension with replicated border; the adjoint scatters instead of gathering.
template <typename scalar_t, int L>
TORCHKCREG_INLINE void blur_rows(const TransmissionShape& p, const scalar_t* kernel, const scalar_t* from, scalar_t* to,
                                 bool adjoint) {
  const int64_t radius = p.taps / 2;
  std::fill(to, to + p.rows * p.cols, scalar_t(0));
  for (int64_t row = 0; row < p.rows; ++row) {
    for (int64_t t = 0; t < p.taps; ++t) {
      const int64_t other = clamped(row + t - radius, p.rows);
      const int64_t read = adjoint ? row : other, write = adjoint ? other : row;
      add_scaled<scalar_t, L>(to + write * p.cols, from + read * p.cols, kernel[t], p.cols);
    }
  }
}

template <typename scalar_t>
TORCHKCREG_INLINE void pad_line(const TransmissionShape& p, const scalar_t* row, scalar_t* line) {
  const int64_t radius = p.taps / 2;
  std::fill(line, line + radius, row[0]);
  std::copy(row, row + p.cols, line + radius);
  std::fill(line + radius + p.cols, line + 2 * radius + p.cols, row[p.cols - 1]);
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void blur_cols(const TransmissionShape& p, const scalar_t* kernel, const scalar_t* from, scalar_t* to,
                                 scalar_t* line) {
  for (int64_t row = 0; row < p.rows; ++row) {
    pad_line(p, from + row * p.cols, line);
    std::fill(to + row * p.cols, to + (row + 1) * p.cols, scalar_t(0));
    for (int64_t t = 0; t < p.taps; ++t) add_scaled<scalar_t, L>(to + row * p.cols, line + t, kernel[t], p.cols);
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void blur_cols_adjoint(const TransmissionShape& p, const scalar_t* kernel, const scalar_t* from,
                                         scalar_t* to, scalar_t* line) {
  const int64_t radius = p.taps / 2;
  for (int64_t row = 0; row < p.rows; ++row) {
    std::fill(line, line + p.cols + 2 * radius, scalar_t(0));
    for (int64_t t = 0; t < p.taps; ++t) add_scaled<scalar_t, L>(line + t, from + row * p.cols, kernel[t], p.cols);
    scalar_t* out = to + row * p.cols;
    std::copy(line + radius, line + radius + p.cols, out);
    for (int64_t i = 0; i < radius; ++i) {
      out[0] += line[i];
      out[p.cols - 1] += line[radius + p.cols + i];
    }
  }
}

// Signal, blurred along rows, blurred along both.
template <typename scalar_t, int L>
TORCHKCREG_INLINE void blurred_signal(const TransmissionShape& p, const TransmissionImage<scalar_t>& in,
                                      TransmissionScratch<scalar_t>& scratch) {
  add_energies<scalar_t, L>(p, in, scratch.signal.data());
  blur_rows<scalar_t, L>(p, in.kernel, scratch.signal.data(), scratch.along_rows.data(), false);
  blur_cols<scalar_t, L>(p, in.kernel, scratch.along_rows.data(), scratch.blurred.data(), scratch.line.data());
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void transmit_image_kernel(const TransmissionShape& p, const TransmissionImage<scalar_t>& in,
                                             TransmissionScratch<scalar_t>& scratch, scalar_t* result) {
  blurred_signal<scalar_t, L>(p, in, scratch);
  const scalar_t share = scalar_t(1) / scalar_t(p.pooling * p.pooling);
  const int64_t cols = p.cols / p.pooling;
  for (int64_t row = 0; row < p.rows / p.pooling; ++row) {
    for (int64_t col = 0; col < cols; ++col) {
      scalar_t sum = 0;
      for (int64_t i = 0; i < p.pooling; ++i) {
        const scalar_t* from = scratch.blurred.data() + (row * p.pooling + i) * p.cols + col * p.pooling;
        for (int64_t j = 0; j < p.pooling; ++j) sum += from[j];
      }
      result[row * cols + col] = sum * share;
    }
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void energy_gradients(const TransmissionShape& p, const TransmissionImage<scalar_t>& in,
                                        const scalar_t* upstream, const ImageGradients<scalar_t>& out) {
  using S = Simd<scalar_t, L>;
  const int64_t pixels = p.rows * p.cols;
  for (int64_t m = 0; m < p.materials; ++m) {
    std::fill(out.lengths + m * out.next_material, out.lengths + m * out.next_material + pixels, scalar_t(0));
  }
  for (int64_t e = 0; e < p.energies; ++e) {
    double to_weight = 0;
    for (int64_t start = 0; start < pixels; start += kPixelsPerSum) {
      typename S::V sum = S::spread(0);
      over_pixels<L>(std::min(kPixelsPerSum, pixels - start), [&](int64_t i, int64_t lanes) {
        const int64_t pixel = start + i;
        const typename S::V part =
            passed<scalar_t, L>(p, in, e, pixel, lanes) * load_some<scalar_t, L>(upstream + pixel, lanes);
        sum += part;
        for (int64_t m = 0; m < p.materials; ++m) {
          scalar_t* to = out.lengths + m * out.next_material + pixel;
          const scalar_t factor = -in.weights[e] * in.attenuation[m * p.energies + e];
          store_some<scalar_t, L>(to, load_some<scalar_t, L>(to, lanes) + part * factor, lanes);
        }
      });
      to_weight += total<scalar_t, L>(sum);
    }
    out.weights[e] = scalar_t(to_weight);
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void attenuation_gradients(const TransmissionShape& p, const TransmissionImage<scalar_t>& in,
                                             const scalar_t* upstream, double* out) {
  using S = Simd<scalar_t, L>;
  const int64_t pixels = p.rows * p.cols;
  for (int64_t m = 0; m < p.materials; ++m) {
    for (int64_t e = 0; e < p.energies; ++e) {
      double moment = 0;
      for (int64_t start = 0; start < pixels; start += kPixelsPerSum) {
        typename S::V sum = S::spread(0);
        over_pixels<L>(std::min(kPixelsPerSum, pixels - start), [&](int64_t i, int64_t lanes) {
          const int64_t pixel = start + i;
          sum += passed<scalar_t, L>(p, in, e, pixel, lanes) * load_some<scalar_t, L>(upstream + pixel, lanes) *
                 load_some<scalar_t, L>(in.lengths + m * in.next_material + pixel, lanes);
        });
        moment += total<scalar_t, L>(sum);
      }
      out[m * p.energies + e] = -double(in.weights[e]) * moment;
    }
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void transmit_image_backward_kernel(const TransmissionShape& p, const TransmissionImage<scalar_t>& in,
                                                      const scalar_t* grad, TransmissionScratch<scalar_t>& scratch,
                                                      const ImageGradients<scalar_t>& out) {
  blurred_signal<scalar_t, L>(p, in, scratch);
  scalar_t *signal = scratch.signal.data(), *along_rows = scratch.along_rows.data(), *spread = scratch.blurred.data();
  const scalar_t share = scalar_t(1) / scalar_t(p.pooling * p.pooling);
  const int64_t radius = p.taps / 2, pooled_cols = p.cols / p.pooling;
  for (int64_t row = 0; row < p.rows; ++row) {
    for (int64_t col = 0; col < p.cols; ++col) {
      spread[row * p.cols + col] = share * grad[row / p.pooling * pooled_cols + col / p.pooling];
    }
  }
  for (int64_t row = 0; row < p.rows; ++row) {  // the second of the two blurs
    pad_line(p, along_rows + row * p.cols, scratch.line.data());
    for (int64_t t = 0; t < p.taps; ++t) {
      out.kernel[t] += dot<scalar_t, L>(scratch.line.data() + t, spread + row * p.cols, p.cols);
    }
  }
  blur_cols_adjoint<scalar_t, L>(p, in.kernel, spread, along_rows, scratch.line.data());
  for (int64_t row = 0; row < p.rows; ++row) {  // the first
    for (int64_t t = 0; t < p.taps; ++t) {
      const int64_t other = clamped(row + t - radius, p.rows);
      out.kernel[t] += dot<scalar_t, L>(signal + other * p.cols, along_rows + row * p.cols, p.cols);
    }
  }
  blur_rows<scalar_t, L>(p, in.kernel, along_rows, spread, true);
  energy_gradients<scalar_t, L>(p, in, spread, out);
  if (out.attenuation) attenuation_gradients<scalar_t, L>(p, in, spread, out.attenuation);
}

TORCHKCREG_BY_PROCESSOR(float, transmit_image,
                        (const TransmissionShape& p, const TransmissionImage<float>& in,
                         TransmissionScratch<float>& scratch, float* result),
                        (p, in, scratch, result))
TORCHKCREG_BY_PROCESSOR(double, transmit_image,
                        (const TransmissionShape& p, const TransmissionImage<double>& in,
                         TransmissionScratch<double>& scratch, double* result),
                        (p, in, scratch, result))
TORCHKCREG_BY_PROCESSOR(float, transmit_image_backward,
                        (const TransmissionShape& p, const TransmissionImage<float>& in, const float* grad,
                         TransmissionScratch<float>& scratch, const ImageGradients<float>& out),
                        (p, in, grad, scratch, out))
TORCHKCREG_BY_PROCESSOR(double, transmit_image_backward,
                        (const TransmissionShape& p, const TransmissionImage<double>& in, const double* grad,
                         TransmissionScratch<double>& scratch, const ImageGradients<double>& out),
                        (p, in, grad, scratch, out))

}  // namespace torchkcreg
