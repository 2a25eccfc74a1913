// Hot loops of the point-cloud DRR, on one chunk of nodes in one view.

#pragma once

#include <algorithm>
#include <cstdint>

#include "dispatch.h"
#include "point_drr_chunk.h"
#include "point_drr_taps.h"

namespace torchkcreg {

// Nodes at a time for which weights or products are kept between a loop that vectorises over nodes and one over taps.
constexpr int64_t kBatch = 128;

// Index of a node's first pixel in a patch with the given number of columns.
template <typename scalar_t>
TORCHKCREG_INLINE int32_t patch_offset(const ChunkView<scalar_t>& chunk, int32_t cols, int64_t i) {
  return (chunk.row[i] - chunk.patch.row_begin) * cols + chunk.col[i] - chunk.patch.col_begin;
}

// Weights of the four corners and positions of the taps, for a batch of nodes.
template <typename scalar_t>
struct BatchWeights {
  alignas(64) scalar_t weights[4 * kBatch];
  alignas(64) int32_t offsets[kBatch];
};

template <typename scalar_t>
TORCHKCREG_INLINE void weigh_corners(const ChunkView<scalar_t>& chunk, const scalar_t* TORCHKCREG_RESTRICT volumes,
                                     int64_t first, int64_t count, int32_t cols, BatchWeights<scalar_t>& batch) {
  for (int64_t k = 0; k < count; ++k) {
    const int64_t i = first + k;
    const scalar_t amplitude = volumes[chunk.node[i]] * chunk.inverse_depth[i] * chunk.inverse_depth[i];
    const scalar_t right = chunk.fraction_u[i], down = chunk.fraction_v[i];
    const scalar_t lower = amplitude * down, upper = amplitude - lower;
    batch.weights[4 * k] = upper - upper * right;
    batch.weights[4 * k + 1] = upper * right;
    batch.weights[4 * k + 2] = lower - lower * right;
    batch.weights[4 * k + 3] = lower * right;
    batch.offsets[k] = patch_offset(chunk, cols, i);
  }
}

// Adds the chunk's nodes to its tile.
template <typename scalar_t, int T>
TORCHKCREG_INLINE void spread_nodes(ChunkView<scalar_t>& chunk, const TableShape& shape,
                                    const scalar_t* TORCHKCREG_RESTRICT table,
                                    const scalar_t* TORCHKCREG_RESTRICT volumes, scalar_t* TORCHKCREG_RESTRICT tile) {
  const int32_t stride = static_cast<int32_t>(chunk.patch.cols());
  const Taps<scalar_t, T> taps{shape.taps, shape.phases + 1, stride};
  const int64_t area = shape.taps * shape.taps;
  BatchWeights<scalar_t> batch;
  if constexpr (Taps<scalar_t, T>::kHasCells) {
    const int64_t rows = chunk.patch.rows() - (T - 1), cols = chunk.patch.cols() - (T - 1);
    // Scattered nodes rarely share pixels, and then cells only add cost.
    if (chunk.count > 0 && rows * cols <= chunk.count) {
      scalar_t* cells = aligned_zeros(rows * cols * T * T, chunk.cells);
      for (int64_t first = 0; first < chunk.count; first += kBatch) {
        const int64_t count = std::min(kBatch, chunk.count - first);
        weigh_corners(chunk, volumes, first, count, static_cast<int32_t>(cols), batch);
        for (int64_t k = 0; k < count; ++k) {
          taps.add_to_cell(table + chunk.phase[first + k] * area, batch.weights + 4 * k,
                           cells + batch.offsets[k] * (T * T));
        }
      }
      taps.merge_cells(cells, rows, cols, tile);
      return;
    }
  }
  for (int64_t first = 0; first < chunk.count; first += kBatch) {
    const int64_t count = std::min(kBatch, chunk.count - first);
    weigh_corners(chunk, volumes, first, count, stride, batch);
    for (int64_t k = 0; k < count; ++k) {
      taps.add(table + chunk.phase[first + k] * area, batch.weights + 4 * k, tile + batch.offsets[k]);
    }
  }
}

template <typename scalar_t>
struct ChunkGradients {
  scalar_t* points;   // (count, 3), added to
  scalar_t* volumes;  // (count,), added to; may be null
  double* matrix;     // (3, 4), added to; may be null
};

// Gradient of a batch of nodes from the image's gradient: for (U, V, W) = P (x, y, z, 1) and for the volume.
template <typename scalar_t>
struct BatchGradients {
  alignas(64) scalar_t u[kBatch], v[kBatch], w[kBatch], volume[kBatch];
};

template <typename scalar_t>
TORCHKCREG_INLINE void chain_rule(const ChunkView<scalar_t>& chunk, scalar_t phases, int64_t first, int64_t batch,
                                  const scalar_t* TORCHKCREG_RESTRICT volumes, const scalar_t* TORCHKCREG_RESTRICT dots,
                                  BatchGradients<scalar_t>& out) {
  for (int64_t k = 0; k < batch; ++k) {
    const int64_t i = first + k;
    const scalar_t s = chunk.inverse_depth[i], right = chunk.fraction_u[i], down = chunk.fraction_v[i];
    const scalar_t amplitude = volumes[chunk.node[i]] * s * s;
    const scalar_t upper_step = dots[4 * k + 1] - dots[4 * k], lower_step = dots[4 * k + 3] - dots[4 * k + 2];
    const scalar_t upper = dots[4 * k] + right * upper_step, lower = dots[4 * k + 2] + right * lower_step;
    const scalar_t value = upper + down * (lower - upper);
    const scalar_t grad_u = amplitude * phases * (upper_step + down * (lower_step - upper_step));
    const scalar_t grad_v = amplitude * phases * (lower - upper);
    // u = U / W, v = V / W, amplitude = volume / W^2
    out.u[k] = grad_u * s;
    out.v[k] = grad_v * s;
    out.w[k] = -(grad_u * chunk.u[i] + grad_v * chunk.v[i] + 2 * amplitude * value) * s;
    out.volume[k] = value * s * s;
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
                                    const scalar_t* TORCHKCREG_RESTRICT table,
                                    const scalar_t* TORCHKCREG_RESTRICT points,
                                    const scalar_t* TORCHKCREG_RESTRICT volumes, const scalar_t* TORCHKCREG_RESTRICT m,
                                    const scalar_t* TORCHKCREG_RESTRICT tile, const ChunkGradients<scalar_t>& grad) {
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
      taps.dot(table + chunk.phase[first + k] * area, tile + patch_offset(chunk, stride, first + k), dots + 4 * k);
    }
    chain_rule(chunk, static_cast<scalar_t>(shape.phases), first, count, volumes, dots, batch);
    for (int64_t k = 0; k < count; ++k) {
      scalar_t* to = grad_points + 3 * node[k];
      to[0] += m0 * batch.u[k] + m4 * batch.v[k] + m8 * batch.w[k];
      to[1] += m1 * batch.u[k] + m5 * batch.v[k] + m9 * batch.w[k];
      to[2] += m2 * batch.u[k] + m6 * batch.v[k] + m10 * batch.w[k];
    }
    if (grad.volumes) {
      for (int64_t k = 0; k < count; ++k) grad.volumes[node[k]] += batch.volume[k];
    }
    if (grad.matrix) add_matrix_gradient(batch, count, node, points, grad.matrix);
  }
}

}  // namespace torchkcreg
