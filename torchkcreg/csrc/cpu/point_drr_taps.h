// The T x T taps of a node: interpolated in its footprint's table, added to or multiplied with a tile of the image.
//
// The four tabulated phases around a node are corners (0, 0), (0, 1), (1, 0), (1, 1) of its table, each T * T
// contiguous taps; `corner` points to the first.

#pragma once

#include <algorithm>
#include <cstdint>

#include "dispatch.h"

namespace torchkcreg {

constexpr int64_t kMaxTaps = 64;

// Any width; T == 0 means that the width is known only at run time.
template <typename scalar_t, int T>
struct Taps {
  static constexpr bool kHasCells = false;
  int64_t taps, phase_stride, tile_stride;

  TORCHKCREG_INLINE int64_t width() const { return T ? T : taps; }

  // tile += sum over corners of weight * corner
  TORCHKCREG_INLINE void add(const scalar_t* TORCHKCREG_RESTRICT corner, const scalar_t* TORCHKCREG_RESTRICT weight,
                             scalar_t* TORCHKCREG_RESTRICT tile) const {
    const int64_t width = this->width(), area = width * width;
    const scalar_t* below = corner + phase_stride * area;
    const scalar_t w0 = weight[0], w1 = weight[1], w2 = weight[2], w3 = weight[3];
    for (int64_t r = 0; r < width; ++r) {
      scalar_t* TORCHKCREG_RESTRICT to = tile + r * tile_stride;
      for (int64_t c = 0; c < width; ++c) {
        const int64_t k = r * width + c;
        to[c] += w0 * corner[k] + w1 * corner[k + area] + w2 * below[k] + w3 * below[k + area];
      }
    }
  }

  // Scalar products of the tile with the four corners.
  TORCHKCREG_INLINE void dot(const scalar_t* TORCHKCREG_RESTRICT corner, const scalar_t* TORCHKCREG_RESTRICT tile,
                             scalar_t* TORCHKCREG_RESTRICT out) const {
    const int64_t width = this->width(), area = width * width;
    const scalar_t* below = corner + phase_stride * area;
    const scalar_t* corners[4] = {corner, corner + area, below, below + area};
    for (int k = 0; k < 4; ++k) {
      // One sum per column, so that the loop over columns vectorises without reordering a sum.
      scalar_t sums[T ? T : kMaxTaps] = {};
      for (int64_t r = 0; r < width; ++r) {
        for (int64_t c = 0; c < width; ++c) sums[c] += tile[r * tile_stride + c] * corners[k][r * width + c];
      }
      out[k] = 0;
      for (int64_t c = 0; c < width; ++c) out[k] += sums[c];
    }
  }
};

#ifdef TORCHKCREG_VECTOR_EXTENSIONS
// Four taps wide is the usual case (a 0.25 mm lattice on 0.4 mm pixels): all 16 taps in one vector.
template <typename scalar_t>
struct Taps<scalar_t, 4> {
  static constexpr bool kHasCells = true;
  typedef scalar_t Vector4 __attribute__((vector_size(4 * sizeof(scalar_t)), aligned(sizeof(scalar_t)), may_alias));
  typedef scalar_t Vector16 __attribute__((vector_size(16 * sizeof(scalar_t)), aligned(sizeof(scalar_t)), may_alias));

  int64_t taps, phase_stride, tile_stride;

  TORCHKCREG_INLINE void add(const scalar_t* TORCHKCREG_RESTRICT corner, const scalar_t* TORCHKCREG_RESTRICT weight,
                             scalar_t* TORCHKCREG_RESTRICT tile) const {
    const scalar_t* below = corner + phase_stride * 16;
    for (int64_t r = 0; r < 4; ++r) {
      row(tile, r) += weight[0] * row4(corner, r) + weight[1] * row4(corner + 16, r) + weight[2] * row4(below, r) +
                      weight[3] * row4(below + 16, r);
    }
  }

  // Consecutive nodes share pixels, and a load that partly overlaps a recent store stalls. So nodes are summed by
  // first pixel, each pixel with its own cell of 16 taps, where loads and stores coincide or don't overlap.
  TORCHKCREG_INLINE void add_to_cell(const scalar_t* TORCHKCREG_RESTRICT corner,
                                     const scalar_t* TORCHKCREG_RESTRICT weight,
                                     scalar_t* TORCHKCREG_RESTRICT cell) const {
    const Vector16* above = reinterpret_cast<const Vector16*>(corner);
    const Vector16* below = above + phase_stride;
    *reinterpret_cast<Vector16*>(cell) +=
        weight[0] * above[0] + weight[1] * above[1] + weight[2] * below[0] + weight[3] * below[1];
  }

  // Adds rows x cols cells to the tile, which is 3 larger either way.
  TORCHKCREG_INLINE void merge_cells(const scalar_t* TORCHKCREG_RESTRICT cells, int64_t rows, int64_t cols,
                                     scalar_t* TORCHKCREG_RESTRICT tile) const {
    const Vector4 zero = {};
    for (int64_t r = 0; r < rows; ++r) {
      Vector4 window[4] = {};  // for each row of taps, sum of the cells so far in this and the next three columns
      for (int64_t c = 0; c < cols + 3; ++c) {
        for (int64_t k = 0; k < 4; ++k) {
          window[k] = __builtin_shufflevector(window[k], zero, 1, 2, 3, 4);
          if (c < cols) window[k] += row4(cells + (r * cols + c) * 16, k);
          tile[(r + k) * tile_stride + c] += window[k][0];
        }
      }
    }
  }

  TORCHKCREG_INLINE void dot(const scalar_t* TORCHKCREG_RESTRICT corner, const scalar_t* TORCHKCREG_RESTRICT tile,
                             scalar_t* TORCHKCREG_RESTRICT out) const {
    const scalar_t* below = corner + phase_stride * 16;
    const Vector4 pixels[4] = {row(tile, 0), row(tile, 1), row(tile, 2), row(tile, 3)};
    const Vector4 upper = add_pairs(multiply(pixels, corner), multiply(pixels, corner + 16));
    const Vector4 lower = add_pairs(multiply(pixels, below), multiply(pixels, below + 16));
    *reinterpret_cast<Vector4*>(out) =
        __builtin_shufflevector(upper, lower, 0, 1, 4, 5) + __builtin_shufflevector(upper, lower, 2, 3, 6, 7);
  }

 private:
  TORCHKCREG_INLINE Vector4& row(scalar_t* tile, int64_t r) const {
    return *reinterpret_cast<Vector4*>(tile + r * tile_stride);
  }
  TORCHKCREG_INLINE const Vector4& row(const scalar_t* tile, int64_t r) const {
    return *reinterpret_cast<const Vector4*>(tile + r * tile_stride);
  }
  static TORCHKCREG_INLINE const Vector4& row4(const scalar_t* taps, int64_t r) {
    return *reinterpret_cast<const Vector4*>(taps + 4 * r);
  }
  // Column by column, the scalar product of 4 x 4 pixels and taps. Vectors of four are native everywhere; compilers
  // take shuffles of larger ones to pieces.
  static TORCHKCREG_INLINE Vector4 multiply(const Vector4* pixels, const scalar_t* taps) {
    return (pixels[0] * row4(taps, 0) + pixels[1] * row4(taps, 1)) +
           (pixels[2] * row4(taps, 2) + pixels[3] * row4(taps, 3));
  }
  // x0 + x2, y0 + y2, x1 + x3, y1 + y3
  static TORCHKCREG_INLINE Vector4 add_pairs(const Vector4& x, const Vector4& y) {
    return __builtin_shufflevector(x, y, 0, 4, 1, 5) + __builtin_shufflevector(x, y, 2, 6, 3, 7);
  }
};
#endif

}  // namespace torchkcreg
