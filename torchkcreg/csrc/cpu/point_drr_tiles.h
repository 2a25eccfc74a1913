// Tasks of the point-cloud DRR: draw one chunk of nodes in one view, or gather its gradients.

#pragma once

#include <algorithm>
#include <cstdint>
#include <vector>

#include "point_drr_kernel.h"

namespace torchkcreg {
namespace {  // compiled into one file only, and kept out of the library's symbols

struct Problem {
  int64_t candidates, nodes, views, rows, cols, block_size, num_blocks;
  TableShape table;

  int64_t chunks_per_block() const { return (std::min(block_size, nodes) + kChunk - 1) / kChunk; }
  int64_t num_chunks() const { return num_blocks * chunks_per_block(); }
  int64_t chunk_begin(int64_t chunk) const { return block(chunk) * block_size + chunk % chunks_per_block() * kChunk; }
  int64_t chunk_size(int64_t chunk) const {
    const int64_t end = std::min({nodes, (block(chunk) + 1) * block_size, chunk_begin(chunk) + kChunk});
    return std::max<int64_t>(end - chunk_begin(chunk), 0);
  }
  int64_t block(int64_t chunk) const { return chunk / chunks_per_block(); }
  int64_t table_offset(int64_t view, int64_t chunk) const {
    const int64_t side = table.phases + 1;
    return (view * num_blocks + block(chunk)) * side * side * table.taps * table.taps;
  }
};

template <typename scalar_t>
struct Inputs {
  const scalar_t *points, *volumes, *matrices, *table;
};

template <typename scalar_t>
struct Tile {
  Patch patch;
  std::vector<scalar_t> pixels;
};

template <typename scalar_t>
TORCHKCREG_INLINE void locate_nodes(const Problem& p, const Inputs<scalar_t>& in, int64_t candidate, int64_t view,
                                    int64_t chunk, ChunkView<scalar_t>& scratch) {
  const int64_t count = p.chunk_size(chunk);
  const scalar_t* points = in.points + (candidate * p.nodes + p.chunk_begin(chunk)) * 3;
  const int64_t seen = project_nodes(points, count, in.matrices + 12 * view, p.table.taps, p.rows, p.cols, scratch);
  compact_nodes(count, seen, scratch);
  locate_taps(p.table, scratch);
}

template <typename scalar_t, int T>
TORCHKCREG_INLINE void draw_tile(const Problem& p, const Inputs<scalar_t>& in, int64_t candidate, int64_t view,
                                 int64_t chunk, ChunkView<scalar_t>& scratch, Tile<scalar_t>& tile) {
  locate_nodes(p, in, candidate, view, chunk, scratch);
  tile.patch = scratch.patch;
  tile.pixels.assign(scratch.patch.size(), scalar_t(0));
  spread_nodes<scalar_t, T>(scratch, p.table, in.table + p.table_offset(view, chunk), in.volumes + p.chunk_begin(chunk),
                            tile.pixels.data());
}

// Copies a patch of an image into a tile, zero beyond the detector.
template <typename scalar_t>
void copy_patch(const Problem& p, const scalar_t* image, Tile<scalar_t>& tile) {
  const Patch& patch = tile.patch;
  tile.pixels.assign(patch.size(), scalar_t(0));
  const int64_t first = std::max<int64_t>(patch.col_begin, 0), last = std::min<int64_t>(patch.col_end, p.cols);
  for (int64_t r = std::max<int64_t>(patch.row_begin, 0); r < std::min<int64_t>(patch.row_end, p.rows); ++r) {
    std::copy(image + r * p.cols + first, image + r * p.cols + last,
              tile.pixels.data() + (r - patch.row_begin) * patch.cols() + first - patch.col_begin);
  }
}

template <typename scalar_t, int T>
TORCHKCREG_INLINE void gather_tile(const Problem& p, const Inputs<scalar_t>& in, const scalar_t* grad,
                                   int64_t candidate, int64_t view, int64_t chunk, ChunkView<scalar_t>& scratch,
                                   Tile<scalar_t>& tile, const ChunkGradients<scalar_t>& out) {
  locate_nodes(p, in, candidate, view, chunk, scratch);
  tile.patch = scratch.patch;
  copy_patch(p, grad + (candidate * p.views + view) * p.rows * p.cols, tile);
  gather_nodes<scalar_t, T>(scratch, p.table, in.table + p.table_offset(view, chunk),
                            in.points + (candidate * p.nodes + p.chunk_begin(chunk)) * 3,
                            in.volumes + p.chunk_begin(chunk), in.matrices + 12 * view, tile.pixels.data(), out);
}

// target_clones works only on plain functions, hence one function for each specialised width: 4 taps for fine lattices,
// 6 and 8 for coarsened ones.
#define TORCHKCREG_TILE_FUNCTIONS(scalar_t, T)                                                                   \
  TORCHKCREG_MULTIVERSION inline void draw_##scalar_t##_##T(const Problem& p, const Inputs<scalar_t>& in,        \
                                                            int64_t candidate, int64_t view, int64_t chunk,      \
                                                            ChunkView<scalar_t>& scratch, Tile<scalar_t>& out) { \
    draw_tile<scalar_t, T>(p, in, candidate, view, chunk, scratch, out);                                         \
  }                                                                                                              \
  TORCHKCREG_MULTIVERSION inline void gather_##scalar_t##_##T(                                                   \
      const Problem& p, const Inputs<scalar_t>& in, const scalar_t* grad, int64_t candidate, int64_t view,       \
      int64_t chunk, ChunkView<scalar_t>& scratch, Tile<scalar_t>& tile, const ChunkGradients<scalar_t>& out) {  \
    gather_tile<scalar_t, T>(p, in, grad, candidate, view, chunk, scratch, tile, out);                           \
  }
#define TORCHKCREG_BY_TAPS(function, scalar_t, taps) \
  ((taps) == 4   ? function##_##scalar_t##_4         \
   : (taps) == 6 ? function##_##scalar_t##_6         \
   : (taps) == 8 ? function##_##scalar_t##_8         \
                 : function##_##scalar_t##_0)
#define TORCHKCREG_TILE_OVERLOADS(scalar_t)                                                                      \
  TORCHKCREG_TILE_FUNCTIONS(scalar_t, 4)                                                                         \
  TORCHKCREG_TILE_FUNCTIONS(scalar_t, 6)                                                                         \
  TORCHKCREG_TILE_FUNCTIONS(scalar_t, 8)                                                                         \
  TORCHKCREG_TILE_FUNCTIONS(scalar_t, 0)                                                                         \
  inline void draw(const Problem& p, const Inputs<scalar_t>& in, int64_t candidate, int64_t view, int64_t chunk, \
                   ChunkView<scalar_t>& scratch, Tile<scalar_t>& out) {                                          \
    TORCHKCREG_BY_TAPS(draw, scalar_t, p.table.taps)(p, in, candidate, view, chunk, scratch, out);               \
  }                                                                                                              \
  inline void gather(const Problem& p, const Inputs<scalar_t>& in, const scalar_t* grad, int64_t candidate,      \
                     int64_t view, int64_t chunk, ChunkView<scalar_t>& scratch, Tile<scalar_t>& tile,            \
                     const ChunkGradients<scalar_t>& out) {                                                      \
    TORCHKCREG_BY_TAPS(gather, scalar_t, p.table.taps)(p, in, grad, candidate, view, chunk, scratch, tile, out); \
  }
TORCHKCREG_TILE_OVERLOADS(float)
TORCHKCREG_TILE_OVERLOADS(double)
#undef TORCHKCREG_TILE_OVERLOADS
#undef TORCHKCREG_BY_TAPS
#undef TORCHKCREG_TILE_FUNCTIONS

}  // namespace
}  // namespace torchkcreg
