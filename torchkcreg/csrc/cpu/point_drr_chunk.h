// A chunk of nodes projected in one view.
//
// A chunk is a run of consecutive nodes of one block, so it shares a footprint table, and (nodes being in Morton order)
// projects to a small patch of the detector. Loops work on a tile of that size: tile, table and scratch stay in the
// nearest caches, taps need no bounds check, and the order of sums does not depend on the number of threads.

#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "dispatch.h"

namespace torchkcreg {

constexpr int64_t kChunk = 2048;
constexpr double kMinDepth = 1e-3;  // mm, as in projector/point_reference.py

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
  std::vector<scalar_t> cells;                                  // scratch of spread_nodes
};

// Zeros that start at a cache line.
template <typename scalar_t>
TORCHKCREG_INLINE scalar_t* aligned_zeros(int64_t count, std::vector<scalar_t>& storage) {
  constexpr uintptr_t kLine = 64;
  storage.assign(count + kLine / sizeof(scalar_t), scalar_t(0));
  const uintptr_t address = reinterpret_cast<uintptr_t>(storage.data());
  return reinterpret_cast<scalar_t*>((address + kLine - 1) / kLine * kLine);
}

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
    const bool inside =
        (depth > static_cast<scalar_t>(kMinDepth)) & (u >= low) & (u < high_u) & (v >= low) & (v < high_v);
    chunk.u[i] = u;
    chunk.v[i] = v;
    chunk.inverse_depth[i] = inverse;
    chunk.node[i] = inside;
    seen += inside;
  }
  return seen;
}

// Removes nodes that miss the detector; on return `node` holds the original index of each remaining one.
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

}  // namespace torchkcreg
