// Shared by the voxel operators: sizes, checks, views.

#pragma once

#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <vector>

#include "voxel_rays.h"

namespace torchkcreg {
namespace {

struct VoxelProblem {
  int64_t batch, rows, cols;
  int64_t counts[3];  // voxels along x, y, z
  double spacing[3];
  std::vector<RayView> views;

  int64_t pixels() const { return rows * cols; }
  int64_t voxels() const { return counts[0] * counts[1] * counts[2]; }
  int64_t num_views() const { return static_cast<int64_t>(views.size()); }
};

inline void check_data(const torch::stable::Tensor& data, const char* shape) {
  using torch::headeronly::ScalarType;
  STD_TORCH_CHECK(data.dim() == 4, "data must have shape ", shape);
  STD_TORCH_CHECK(data.is_cpu(), "data must be on the CPU");
  STD_TORCH_CHECK(data.scalar_type() == ScalarType::Float || data.scalar_type() == ScalarType::Double,
                  "data must be float32 or float64");
}

// Images (B, V, rows, cols) without a copy: a slice of views is read in place; only pixels must be contiguous.
template <typename scalar_t>
struct ImageStack {
  const scalar_t* first;
  int64_t batch_stride, view_stride;

  explicit ImageStack(const torch::stable::Tensor& images)
      : first(images.const_data_ptr<scalar_t>()), batch_stride(images.stride(0)), view_stride(images.stride(1)) {}
  const scalar_t* at(int64_t batch, int64_t view) const { return first + batch * batch_stride + view * view_stride; }
};

inline torch::stable::Tensor with_contiguous_pixels(const torch::stable::Tensor& images) {
  const bool contiguous = images.stride(3) == 1 && images.stride(2) == images.size(3);
  return contiguous ? images : torch::stable::contiguous(images);
}

inline torch::stable::Tensor check_matrices(const torch::stable::Tensor& matrices) {
  STD_TORCH_CHECK(matrices.dim() == 3 && matrices.size(1) == 3 && matrices.size(2) == 4,
                  "matrices must have shape (V, 3, 4)");
  STD_TORCH_CHECK(matrices.is_cpu() && matrices.scalar_type() == torch::headeronly::ScalarType::Double,
                  "matrices must be float64 on the CPU");
  return torch::stable::contiguous(matrices);
}

// Checks that sizes fit the 32-bit indices used in the kernels.
inline void check_sizes(const int64_t* counts, int64_t rows, int64_t cols) {
  constexpr int64_t kMost = int64_t(1) << 20, kElements = int64_t(1) << 31;
  for (const int64_t n : {counts[0], counts[1], counts[2], rows, cols}) {
    STD_TORCH_CHECK(n > 0 && n < kMost, "volume and images must have from 1 to 2^20 elements along each axis");
  }
  STD_TORCH_CHECK(
      (counts[0] + 2) * (counts[1] + 2) * (counts[2] + 64) < kElements && (rows + 64) * (cols + 2) < kElements,
      "volume and images must have fewer than 2^31 elements");
}

inline VoxelProblem voxel_problem(int64_t batch, int64_t depth, int64_t height, int64_t width, int64_t rows,
                                  int64_t cols, const torch::stable::Tensor& rays_,
                                  const torch::stable::Tensor& spacing_) {
  VoxelProblem p{batch, rows, cols, {width, height, depth}, {}, {}};
  check_sizes(p.counts, rows, cols);
  const torch::stable::Tensor rays = check_matrices(rays_), spacing = torch::stable::contiguous(spacing_);
  STD_TORCH_CHECK(spacing.dim() == 1 && spacing.size(0) == 3 && spacing.is_cpu() &&
                      spacing.scalar_type() == torch::headeronly::ScalarType::Double,
                  "spacing must be float64 of shape (3,)");
  for (int k = 0; k < 3; ++k) p.spacing[k] = spacing.const_data_ptr<double>()[k];
  p.views.reserve(rays.size(0));
  for (int64_t v = 0; v < rays.size(0); ++v) {
    p.views.push_back(read_view(rays.const_data_ptr<double>() + 12 * v, p.counts, rows, cols));
  }
  return p;
}

}  // namespace
}  // namespace torchkcreg
