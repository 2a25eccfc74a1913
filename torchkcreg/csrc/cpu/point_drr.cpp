// CPU kernels of the point-cloud DRR: splits the work into tasks. The tasks themselves are in point_drr_tiles.h.
//
// The order of sums does not depend on the number of threads. Forward, each chunk of nodes draws its own tile, and
// tiles are added to an image in the order of chunks, each row by one thread. Backward, a chunk's gradients belong to
// one task, which takes views and (where volumes share a gradient) candidates in order.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <memory>
#include <tuple>
#include <vector>

#include "point_drr_tiles.h"

namespace torchkcreg {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

constexpr int64_t kTilesAtOnce = 512;  // bounds the memory for tiles; does not change any sum
constexpr int64_t kBandRows = 32;

// Adds a tile's rows in [row_begin, row_end) to an image.
template <typename scalar_t>
void add_rows(const Problem& p, const Tile<scalar_t>& tile, int64_t row_begin, int64_t row_end, scalar_t* image) {
  const Patch& patch = tile.patch;
  const int64_t first = std::max<int64_t>(patch.col_begin, 0), last = std::min<int64_t>(patch.col_end, p.cols);
  row_begin = std::max<int64_t>(patch.row_begin, row_begin);
  row_end = std::min<int64_t>(patch.row_end, row_end);
  for (int64_t r = row_begin; r < row_end; ++r) {
    const scalar_t* from = tile.pixels.data() + (r - patch.row_begin) * patch.cols() - patch.col_begin;
    for (int64_t c = first; c < last; ++c) image[r * p.cols + c] += from[c];
  }
}

template <typename scalar_t>
void draw_images(const Problem& p, const Inputs<scalar_t>& in, scalar_t* images) {
  const int64_t chunks = p.num_chunks(), total = p.candidates * p.views * chunks;
  const int64_t bands = (p.rows + kBandRows - 1) / kBandRows;
  std::vector<Tile<scalar_t>> tiles(std::min(total, kTilesAtOnce));
  for (int64_t start = 0; start < total; start += kTilesAtOnce) {
    const int64_t end = std::min(start + kTilesAtOnce, total);
    torch::stable::parallel_for(start, end, 1, [&](int64_t begin, int64_t stop) {
      const auto scratch = std::make_unique<ChunkView<scalar_t>>();
      for (int64_t t = begin; t < stop; ++t) {
        const int64_t image = t / chunks;
        draw(p, in, image / p.views, image % p.views, t % chunks, *scratch, tiles[t - start]);
      }
    });
    const int64_t first_image = start / chunks, num_images = (end - 1) / chunks - first_image + 1;
    torch::stable::parallel_for(0, num_images * bands, 1, [&](int64_t begin, int64_t stop) {
      for (int64_t k = begin; k < stop; ++k) {
        const int64_t image = first_image + k / bands, row = k % bands * kBandRows;
        const int64_t from = std::max(start, image * chunks), to = std::min(end, (image + 1) * chunks);
        for (int64_t t = from; t < to; ++t) {
          add_rows(p, tiles[t - start], row, std::min(row + kBandRows, p.rows), images + image * p.rows * p.cols);
        }
      }
    });
  }
}

template <typename scalar_t>
struct Gradients {
  scalar_t *points, *volumes, *matrices;  // zeros; the latter two may be null
};

template <typename scalar_t>
void gather_gradients(const Problem& p, const Inputs<scalar_t>& in, const scalar_t* grad,
                      const Gradients<scalar_t>& out) {
  const int64_t chunks = p.num_chunks();
  std::vector<double> shares(out.matrices ? p.candidates * chunks * p.views * 12 : 0);
  const auto gather_chunk = [&](int64_t b, int64_t c, ChunkView<scalar_t>& scratch, Tile<scalar_t>& tile) {
    for (int64_t v = 0; v < p.views; ++v) {
      const ChunkGradients<scalar_t> to{out.points + (b * p.nodes + p.chunk_begin(c)) * 3,
                                        out.volumes ? out.volumes + p.chunk_begin(c) : nullptr,
                                        out.matrices ? shares.data() + ((b * chunks + c) * p.views + v) * 12 : nullptr};
      gather(p, in, grad, b, v, c, scratch, tile, to);
    }
  };
  // Candidates share the gradient of the volumes, so one task handles a chunk for all candidates.
  const int64_t outer = out.volumes ? 1 : p.candidates, inner = out.volumes ? p.candidates : 1;
  torch::stable::parallel_for(0, outer * chunks, 1, [&](int64_t begin, int64_t stop) {
    const auto scratch = std::make_unique<ChunkView<scalar_t>>();
    Tile<scalar_t> tile;
    for (int64_t t = begin; t < stop; ++t) {
      for (int64_t b = 0; b < inner; ++b) gather_chunk(t / chunks + b, t % chunks, *scratch, tile);
    }
  });
  if (!out.matrices) return;
  std::vector<double> sums(p.views * 12);
  for (int64_t k = 0; k < static_cast<int64_t>(shares.size()); ++k) sums[k % (p.views * 12)] += shares[k];
  for (size_t k = 0; k < sums.size(); ++k) out.matrices[k] = static_cast<scalar_t>(sums[k]);
}

Problem check(const Tensor& points, const Tensor& volumes, const Tensor& matrices, const Tensor& table,
              int64_t block_size, int64_t rows, int64_t cols) {
  STD_TORCH_CHECK(points.dim() == 3 && points.size(2) == 3, "points must have shape (B, N, 3)");
  STD_TORCH_CHECK(volumes.dim() == 1 && volumes.size(0) == points.size(1), "volumes must have shape (N,)");
  STD_TORCH_CHECK(matrices.dim() == 3 && matrices.size(1) == 3 && matrices.size(2) == 4,
                  "matrices must have shape (V, 3, 4)");
  STD_TORCH_CHECK(table.dim() == 6 && table.size(2) == table.size(3) && table.size(4) == table.size(5),
                  "table must have shape (V, num_blocks, R + 1, R + 1, T, T)");
  STD_TORCH_CHECK(table.size(2) >= 2 && table.size(4) >= 2 && table.size(4) % 2 == 0,
                  "table must have at least one phase and an even number of taps");
  STD_TORCH_CHECK(table.size(4) <= kMaxTaps, "table must have at most 64 taps");
  STD_TORCH_CHECK(block_size > 0, "block_size must be positive");
  STD_TORCH_CHECK(rows > 0 && cols > 0 && rows < (1 << 24) && cols < (1 << 24), "rows and cols must be positive");
  const int64_t num_blocks = (points.size(1) + block_size - 1) / block_size;
  STD_TORCH_CHECK(table.size(0) == matrices.size(0) && table.size(1) == num_blocks,
                  "table must have one entry for each view and block");
  const ScalarType dtype = points.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double, "points must be float32 or float64");
  for (const Tensor* t : {&points, &volumes, &matrices, &table}) {
    STD_TORCH_CHECK(t->is_cpu() && t->scalar_type() == dtype, "tensors must be on the CPU and of one dtype");
  }
  return Problem{points.size(0), points.size(1), matrices.size(0), rows,
                 cols,           block_size,     num_blocks,       TableShape{table.size(2) - 1, table.size(4)}};
}

template <typename scalar_t>
Inputs<scalar_t> pointers(const Tensor& points, const Tensor& volumes, const Tensor& matrices, const Tensor& table) {
  return {points.const_data_ptr<scalar_t>(), volumes.const_data_ptr<scalar_t>(), matrices.const_data_ptr<scalar_t>(),
          table.const_data_ptr<scalar_t>()};
}

Tensor point_drr(const Tensor& points_, const Tensor& volumes_, const Tensor& matrices_, const Tensor& table_,
                 int64_t block_size, int64_t rows, int64_t cols) {
  const Problem p = check(points_, volumes_, matrices_, table_, block_size, rows, cols);
  const Tensor points = torch::stable::contiguous(points_), volumes = torch::stable::contiguous(volumes_);
  const Tensor matrices = torch::stable::contiguous(matrices_), table = torch::stable::contiguous(table_);
  Tensor images = torch::stable::new_zeros(points, {p.candidates, p.views, rows, cols});
  if (points.scalar_type() == ScalarType::Float) {
    draw_images(p, pointers<float>(points, volumes, matrices, table), images.mutable_data_ptr<float>());
  } else {
    draw_images(p, pointers<double>(points, volumes, matrices, table), images.mutable_data_ptr<double>());
  }
  return images;
}

template <typename scalar_t>
Gradients<scalar_t> gradient_pointers(const Tensor& points, const Tensor& volumes, const Tensor& matrices) {
  return {points.mutable_data_ptr<scalar_t>(), volumes.numel() ? volumes.mutable_data_ptr<scalar_t>() : nullptr,
          matrices.numel() ? matrices.mutable_data_ptr<scalar_t>() : nullptr};
}

std::tuple<Tensor, Tensor, Tensor> point_drr_backward(const Tensor& grad_, const Tensor& points_,
                                                      const Tensor& volumes_, const Tensor& matrices_,
                                                      const Tensor& table_, int64_t block_size, bool need_volumes,
                                                      bool need_matrices) {
  STD_TORCH_CHECK(grad_.dim() == 4, "grad must have shape (B, V, rows, cols)");
  const Problem p = check(points_, volumes_, matrices_, table_, block_size, grad_.size(2), grad_.size(3));
  STD_TORCH_CHECK(grad_.size(0) == p.candidates && grad_.size(1) == p.views && grad_.is_cpu() &&
                      grad_.scalar_type() == points_.scalar_type(),
                  "grad must fit the images");
  const Tensor points = torch::stable::contiguous(points_), volumes = torch::stable::contiguous(volumes_);
  const Tensor matrices = torch::stable::contiguous(matrices_), table = torch::stable::contiguous(table_);
  const Tensor grad = torch::stable::contiguous(grad_);
  Tensor to_points = torch::stable::new_zeros(points, {p.candidates, p.nodes, 3});
  Tensor to_volumes = torch::stable::new_zeros(points, {need_volumes ? p.nodes : 0});
  Tensor to_matrices =
      need_matrices ? torch::stable::new_zeros(points, {p.views, 3, 4}) : torch::stable::new_zeros(points, {0});
  if (points.scalar_type() == ScalarType::Float) {
    gather_gradients(p, pointers<float>(points, volumes, matrices, table), grad.const_data_ptr<float>(),
                     gradient_pointers<float>(to_points, to_volumes, to_matrices));
  } else {
    gather_gradients(p, pointers<double>(points, volumes, matrices, table), grad.const_data_ptr<double>(),
                     gradient_pointers<double>(to_points, to_volumes, to_matrices));
  }
  return {to_points, to_volumes, to_matrices};
}

}  // namespace
}  // namespace torchkcreg

STABLE_TORCH_LIBRARY_IMPL(torchkcreg, CPU, m) {
  m.impl("point_drr", TORCH_BOX(&torchkcreg::point_drr));
  m.impl("point_drr_backward", TORCH_BOX(&torchkcreg::point_drr_backward));
}
