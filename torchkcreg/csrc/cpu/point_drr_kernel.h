// Hot loops of the point-cloud DRR, on one chunk of nodes in one view.
//
// A chunk is a run of consecutive nodes of one block, so it shares a footprint table, and (nodes being in Morton order)
// projects to a small patch of the detector. It works on a tile of that size: tile, table and scratch stay in the
// first-level cache, taps need no bounds check, and what to sum with whom depends on the problem alone, never on threads.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>

#include "dispatch.h"

namespace torchkcreg {

constexpr int64_t kChunk = 2048;
constexpr double kMinDepth = 1e-3;  // mm, as in projector/reference.py

struct TableShape {
  int64_t phases;  // R
  int64_t taps;    // T
};

// Pixels [row_begin, row_end) x [col_begin, col_end) that a chunk reaches; may stick out of the detector.
struct Patch {
  int32_t row_begin = 0, row_end = 0, col_begin = 0, col_end = 0;
  int64_t rows() const { return row_end - row_begin; }
  int64_t cols() const { return col_end - col_begin; }
  int64_t size() const { return rows() * cols(); }
};

// The nodes of a chunk that reach the detector in one view.
template <typename scalar_t>
struct ChunkView {
  int64_t count;
  Patch patch;
  alignas(64) scalar_t u[kChunk], v[kChunk];
  alignas(64) scalar_t inverse_depth[kChunk];
  alignas(64) scalar_t fraction_u[kChunk], fraction_v[kChunk];  // position between two tabulated phases
  alignas(64) int32_t row[kChunk], col[kChunk];                 // first pixel reached
  alignas(64) int32_t phase[kChunk];                            // index of the lower phase pair in the table
  alignas(64) int32_t node[kChunk];                             // index in the chunk
};

// Rounds towards minus infinity; unlike std::floor this vectorises on every x86-64.
template <typename scalar_t>
TORCHKCREG_INLINE int32_t floor_to_int(scalar_t x) {
  const int32_t truncated = static_cast<int32_t>(x);
  return truncated - (static_cast<scalar_t>(truncated) > x ? 1 : 0);
}

// Pixel coordinates of every node; `node` is 1 where the node reaches the detector. Returns how many do.
template <typename scalar_t>
TORCHKCREG_INLINE int64_t project_nodes(const scalar_t* TORCHKCREG_RESTRICT points, int64_t count,
                                        const scalar_t* TORCHKCREG_RESTRICT matrix, int64_t taps, int64_t rows,
                                        int64_t cols, ChunkView<scalar_t>& chunk) {
  const scalar_t m0 = matrix[0], m1 = matrix[1], m2 = matrix[2], m3 = matrix[3];
  const scalar_t m4 = matrix[4], m5 = matrix[5], m6 = matrix[6], m7 = matrix[7];
  const scalar_t m8 = matrix[8], m9 = matrix[9], m10 = matrix[10], m11 = matrix[11];
  const scalar_t low = -static_cast<scalar_t>(taps / 2);
  const scalar_t high_u = static_cast<scalar_t>(cols + taps / 2 - 1);
  const scalar_t high_v = static_cast<scalar_t>(rows + taps / 2 - 1);
  int32_t seen = 0;
  for (int64_t i = 0; i < count; ++i) {
    const scalar_t x = points[3 * i], y = points[3 * i + 1], z = points[3 * i + 2];
    const scalar_t depth = m8 * x + m9 * y + m10 * z + m11;
    const scalar_t inverse = scalar_t(1) / depth;
    const scalar_t u = (m0 * x + m1 * y + m2 * z + m3) * inverse;
    const scalar_t v = (m4 * x + m5 * y + m6 * z + m7) * inverse;
    // Bitwise, so that it vectorises; false for NaN.
    const bool inside = (depth > static_cast<scalar_t>(kMinDepth)) & (u >= low) & (u < high_u) & (v >= low) & (v < high_v);
    chunk.u[i] = u;
    chunk.v[i] = v;
    chunk.inverse_depth[i] = inverse;
    chunk.node[i] = inside;
    seen += inside;
  }
  return seen;
}

// Closes the gaps that unseen nodes leave; on return `node` tells where each one comes from.
template <typename scalar_t>
TORCHKCREG_INLINE void compact_nodes(int64_t count, int64_t seen, ChunkView<scalar_t>& chunk) {
  chunk.count = seen;
  if (seen == count) {
    for (int64_t i = 0; i < count; ++i) chunk.node[i] = static_cast<int32_t>(i);
    return;
  }
  int64_t kept = 0;
  for (int64_t i = 0; i < count; ++i) {
    const int32_t inside = chunk.node[i];
    chunk.u[kept] = chunk.u[i];
    chunk.v[kept] = chunk.v[i];
    chunk.inverse_depth[kept] = chunk.inverse_depth[i];
    chunk.node[kept] = static_cast<int32_t>(i);
    kept += inside;
    if (kept == seen) break;
  }
}

// Splits pixel coordinates into first pixel, phase, and position between phases; finds the patch.
template <typename scalar_t>
TORCHKCREG_INLINE void locate_taps(const TableShape& shape, ChunkView<scalar_t>& chunk) {
  const int32_t last_phase = static_cast<int32_t>(shape.phases - 1);
  const int32_t phase_stride = static_cast<int32_t>(shape.phases + 1);
  const int32_t before = static_cast<int32_t>(shape.taps / 2 - 1);
  const scalar_t phases = static_cast<scalar_t>(shape.phases);
  int32_t row_min = INT32_MAX, row_max = INT32_MIN, col_min = INT32_MAX, col_max = INT32_MIN;
  for (int64_t i = 0; i < chunk.count; ++i) {
    const scalar_t u = chunk.u[i], v = chunk.v[i];
    const int32_t pixel_u = floor_to_int(u), pixel_v = floor_to_int(v);
    const scalar_t position_u = (u - static_cast<scalar_t>(pixel_u)) * phases;
    const scalar_t position_v = (v - static_cast<scalar_t>(pixel_v)) * phases;
    // Rounding can take a position just below a pixel to R itself.
    const int32_t phase_u = std::min(static_cast<int32_t>(position_u), last_phase);
    const int32_t phase_v = std::min(static_cast<int32_t>(position_v), last_phase);
    chunk.fraction_u[i] = position_u - static_cast<scalar_t>(phase_u);
    chunk.fraction_v[i] = position_v - static_cast<scalar_t>(phase_v);
    chunk.phase[i] = phase_v * phase_stride + phase_u;
    const int32_t row = pixel_v - before, col = pixel_u - before;
    chunk.row[i] = row;
    chunk.col[i] = col;
    row_min = std::min(row_min, row);
    row_max = std::max(row_max, row);
    col_min = std::min(col_min, col);
    col_max = std::max(col_max, col);
  }
  const int32_t taps = static_cast<int32_t>(shape.taps);
  chunk.patch = chunk.count > 0 ? Patch{row_min, row_max + taps, col_min, col_max + taps} : Patch{};
}

// T x T taps of a node: `tile += sum over the four phase corners of weight * corner`. T == 0: width known at run time.
template <typename scalar_t, int T>
struct Taps {
  int64_t taps, phase_stride, tile_stride;

  TORCHKCREG_INLINE int64_t width() const { return T ? T : taps; }

  TORCHKCREG_INLINE void add(const scalar_t* TORCHKCREG_RESTRICT corner, const scalar_t* TORCHKCREG_RESTRICT weight,
                             scalar_t* TORCHKCREG_RESTRICT tile) const {
    const int64_t width = this->width(), area = width * width;
    const scalar_t* below = corner + phase_stride * area;
    for (int64_t r = 0; r < width; ++r) {
      for (int64_t c = 0; c < width; ++c) {
        const int64_t k = r * width + c;
        tile[r * tile_stride + c] += weight[0] * corner[k] + weight[1] * corner[k + area] + weight[2] * below[k] +
                                     weight[3] * below[k + area];
      }
    }
  }

  // The scalar products of the tile with the four corners.
  TORCHKCREG_INLINE void dot(const scalar_t* TORCHKCREG_RESTRICT corner, const scalar_t* TORCHKCREG_RESTRICT tile,
                             scalar_t* TORCHKCREG_RESTRICT out) const {
    const int64_t width = this->width(), area = width * width;
    const scalar_t* below = corner + phase_stride * area;
    scalar_t sums[4] = {0, 0, 0, 0};
    for (int64_t r = 0; r < width; ++r) {
      for (int64_t c = 0; c < width; ++c) {
        const int64_t k = r * width + c;
        const scalar_t pixel = tile[r * tile_stride + c];
        sums[0] += pixel * corner[k];
        sums[1] += pixel * corner[k + area];
        sums[2] += pixel * below[k];
        sums[3] += pixel * below[k + area];
      }
    }
    std::copy(sums, sums + 4, out);
  }
};

#ifdef TORCHKCREG_VECTOR_EXTENSIONS
// Four taps wide is the usual case (a 0.25 mm lattice on 0.4 mm pixels): all 16 in one vector.
template <typename scalar_t>
struct Taps<scalar_t, 4> {
  typedef scalar_t Vector4 __attribute__((vector_size(4 * sizeof(scalar_t)), aligned(sizeof(scalar_t)), may_alias));
  typedef scalar_t Vector8 __attribute__((vector_size(8 * sizeof(scalar_t)), aligned(sizeof(scalar_t)), may_alias));
  typedef scalar_t Vector16 __attribute__((vector_size(16 * sizeof(scalar_t)), aligned(sizeof(scalar_t)), may_alias));

  int64_t taps, phase_stride, tile_stride;

  TORCHKCREG_INLINE void add(const scalar_t* TORCHKCREG_RESTRICT corner, const scalar_t* TORCHKCREG_RESTRICT weight,
                             scalar_t* TORCHKCREG_RESTRICT tile) const {
    const Vector16* above = reinterpret_cast<const Vector16*>(corner);
    const Vector16* below = above + phase_stride;
    const Vector16 sum = weight[0] * above[0] + weight[1] * above[1] + weight[2] * below[0] + weight[3] * below[1];
    row(tile, 0) += __builtin_shufflevector(sum, sum, 0, 1, 2, 3);
    row(tile, 1) += __builtin_shufflevector(sum, sum, 4, 5, 6, 7);
    row(tile, 2) += __builtin_shufflevector(sum, sum, 8, 9, 10, 11);
    row(tile, 3) += __builtin_shufflevector(sum, sum, 12, 13, 14, 15);
  }

  TORCHKCREG_INLINE void dot(const scalar_t* TORCHKCREG_RESTRICT corner, const scalar_t* TORCHKCREG_RESTRICT tile,
                             scalar_t* TORCHKCREG_RESTRICT out) const {
    const Vector16* above = reinterpret_cast<const Vector16*>(corner);
    const Vector16* below = above + phase_stride;
    const Vector8 upper = __builtin_shufflevector(row(tile, 0), row(tile, 1), 0, 1, 2, 3, 4, 5, 6, 7);
    const Vector8 lower = __builtin_shufflevector(row(tile, 2), row(tile, 3), 0, 1, 2, 3, 4, 5, 6, 7);
    const Vector16 pixels =
        __builtin_shufflevector(upper, lower, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const Vector16 a = add_pairs(pixels * above[0], pixels * above[1]);
    const Vector16 b = add_pairs(pixels * below[0], pixels * below[1]);
    // Every group of four now adds up to the four scalar products' shares of one row.
    const Vector16 shares =
        __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
        __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    const Vector8 half = __builtin_shufflevector(shares, shares, 0, 1, 2, 3, 4, 5, 6, 7) +
                         __builtin_shufflevector(shares, shares, 8, 9, 10, 11, 12, 13, 14, 15);
    *reinterpret_cast<Vector4*>(out) =
        __builtin_shufflevector(half, half, 0, 1, 2, 3) + __builtin_shufflevector(half, half, 4, 5, 6, 7);
  }

 private:
  TORCHKCREG_INLINE Vector4& row(scalar_t* tile, int64_t r) const {
    return *reinterpret_cast<Vector4*>(tile + r * tile_stride);
  }
  TORCHKCREG_INLINE const Vector4& row(const scalar_t* tile, int64_t r) const {
    return *reinterpret_cast<const Vector4*>(tile + r * tile_stride);
  }
  // In every group of four: x0 + x2, y0 + y2, x1 + x3, y1 + y3.
  static TORCHKCREG_INLINE Vector16 add_pairs(const Vector16& x, const Vector16& y) {
    return __builtin_shufflevector(x, y, 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29) +
           __builtin_shufflevector(x, y, 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
  }
};
#endif

// Nodes at a time for which weights or products are kept between a loop that vectorises over nodes and one over taps.
constexpr int64_t kBatch = 128;

template <typename scalar_t>
TORCHKCREG_INLINE int32_t tile_offset(const ChunkView<scalar_t>& chunk, int32_t stride, int64_t i) {
  return (chunk.row[i] - chunk.patch.row_begin) * stride + chunk.col[i] - chunk.patch.col_begin;
}

// Adds the chunk's nodes to its tile.
template <typename scalar_t, int T>
TORCHKCREG_INLINE void spread_nodes(const ChunkView<scalar_t>& chunk, const TableShape& shape,
                                    const scalar_t* TORCHKCREG_RESTRICT table,
                                    const scalar_t* TORCHKCREG_RESTRICT masses, scalar_t* TORCHKCREG_RESTRICT tile) {
  const int32_t stride = static_cast<int32_t>(chunk.patch.cols());
  const Taps<scalar_t, T> taps{shape.taps, shape.phases + 1, stride};
  const int64_t area = shape.taps * shape.taps;
  alignas(64) scalar_t weights[4 * kBatch];
  alignas(64) int32_t offsets[kBatch];
  for (int64_t first = 0; first < chunk.count; first += kBatch) {
    const int64_t batch = std::min(kBatch, chunk.count - first);
    for (int64_t k = 0; k < batch; ++k) {
      const int64_t i = first + k;
      const scalar_t amplitude = masses[chunk.node[i]] * chunk.inverse_depth[i] * chunk.inverse_depth[i];
      const scalar_t right = chunk.fraction_u[i], down = chunk.fraction_v[i];
      const scalar_t lower = amplitude * down, upper = amplitude - lower;
      weights[4 * k] = upper - upper * right;
      weights[4 * k + 1] = upper * right;
      weights[4 * k + 2] = lower - lower * right;
      weights[4 * k + 3] = lower * right;
      offsets[k] = tile_offset(chunk, stride, i);
    }
    for (int64_t k = 0; k < batch; ++k) {
      taps.add(table + chunk.phase[first + k] * area, weights + 4 * k, tile + offsets[k]);
    }
  }
}

template <typename scalar_t>
struct ChunkGradients {
  scalar_t* points;  // (count, 3), added to
  scalar_t* masses;  // (count,), added to; may be null
  double* matrix;    // (3, 4), added to; may be null
};

// What the image's gradient says of a batch of nodes: of (U, V, W) = P (x, y, z, 1), and of the mass.
template <typename scalar_t>
struct BatchGradients {
  alignas(64) scalar_t u[kBatch], v[kBatch], w[kBatch], mass[kBatch];
};

template <typename scalar_t>
TORCHKCREG_INLINE void chain_rule(const ChunkView<scalar_t>& chunk, scalar_t phases, int64_t first, int64_t batch,
                                  const scalar_t* TORCHKCREG_RESTRICT masses, const scalar_t* TORCHKCREG_RESTRICT dots,
                                  BatchGradients<scalar_t>& out) {
  for (int64_t k = 0; k < batch; ++k) {
    const int64_t i = first + k;
    const scalar_t s = chunk.inverse_depth[i], right = chunk.fraction_u[i], down = chunk.fraction_v[i];
    const scalar_t amplitude = masses[chunk.node[i]] * s * s;
    const scalar_t upper_step = dots[4 * k + 1] - dots[4 * k], lower_step = dots[4 * k + 3] - dots[4 * k + 2];
    const scalar_t upper = dots[4 * k] + right * upper_step, lower = dots[4 * k + 2] + right * lower_step;
    const scalar_t value = upper + down * (lower - upper);
    const scalar_t grad_u = amplitude * phases * (upper_step + down * (lower_step - upper_step));
    const scalar_t grad_v = amplitude * phases * (lower - upper);
    // u = U / W, v = V / W, amplitude = mass / W^2
    out.u[k] = grad_u * s;
    out.v[k] = grad_v * s;
    out.w[k] = -(grad_u * chunk.u[i] + grad_v * chunk.v[i] + 2 * amplitude * value) * s;
    out.mass[k] = value * s * s;
  }
}

template <typename scalar_t>
TORCHKCREG_INLINE void add_matrix_gradient(const BatchGradients<scalar_t>& batch, int64_t count, const int32_t* node,
                                           const scalar_t* TORCHKCREG_RESTRICT points, double* matrix) {
  double sums[12];
  std::copy(matrix, matrix + 12, sums);
  for (int64_t k = 0; k < count; ++k) {
    const scalar_t* point = points + 3 * node[k];
    const double position[4] = {point[0], point[1], point[2], 1.0};
    const double grad[3] = {batch.u[k], batch.v[k], batch.w[k]};
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 4; ++c) sums[4 * r + c] += grad[r] * position[c];
    }
  }
  std::copy(sums, sums + 12, matrix);
}

// Gradients of the chunk's nodes from a tile of the image's gradient.
template <typename scalar_t, int T>
TORCHKCREG_INLINE void gather_nodes(const ChunkView<scalar_t>& chunk, const TableShape& shape,
                                    const scalar_t* TORCHKCREG_RESTRICT table, const scalar_t* TORCHKCREG_RESTRICT points,
                                    const scalar_t* TORCHKCREG_RESTRICT masses,
                                    const scalar_t* TORCHKCREG_RESTRICT m, const scalar_t* TORCHKCREG_RESTRICT tile,
                                    const ChunkGradients<scalar_t>& grad) {
  const int32_t stride = static_cast<int32_t>(chunk.patch.cols());
  const Taps<scalar_t, T> taps{shape.taps, shape.phases + 1, stride};
  const int64_t area = shape.taps * shape.taps;
  const scalar_t m0 = m[0], m1 = m[1], m2 = m[2], m4 = m[4], m5 = m[5], m6 = m[6], m8 = m[8], m9 = m[9], m10 = m[10];
  scalar_t* TORCHKCREG_RESTRICT grad_points = grad.points;
  alignas(64) scalar_t dots[4 * kBatch];
  BatchGradients<scalar_t> batch;
  for (int64_t first = 0; first < chunk.count; first += kBatch) {
    const int64_t count = std::min(kBatch, chunk.count - first);
    const int32_t* node = chunk.node + first;
    for (int64_t k = 0; k < count; ++k) {
      taps.dot(table + chunk.phase[first + k] * area, tile + tile_offset(chunk, stride, first + k), dots + 4 * k);
    }
    chain_rule(chunk, static_cast<scalar_t>(shape.phases), first, count, masses, dots, batch);
    for (int64_t k = 0; k < count; ++k) {
      scalar_t* to = grad_points + 3 * node[k];
      to[0] += m0 * batch.u[k] + m4 * batch.v[k] + m8 * batch.w[k];
      to[1] += m1 * batch.u[k] + m5 * batch.v[k] + m9 * batch.w[k];
      to[2] += m2 * batch.u[k] + m6 * batch.v[k] + m10 * batch.w[k];
    }
    if (grad.masses) {
      for (int64_t k = 0; k < count; ++k) grad.masses[node[k]] += batch.mass[k];
    }
    if (grad.matrix) add_matrix_gradient(batch, count, node, points, grad.matrix);
  }
}

}  // namespace torchkcreg
