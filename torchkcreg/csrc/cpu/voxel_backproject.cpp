// CPU kernel of the voxel projector's adjoint. Each task handles a few lattice planes of an axis and adds all rays
// sampled there, view after view, so the order of a voxel's sum does not depend on the number of threads.

#include <torch/csrc/stable/library.h>

#include "voxel_columns.h"
#include "voxel_lattice.h"
#include "voxel_problem.h"

namespace torchkcreg {
namespace {

constexpr int64_t kBlockPlanes = 4;
constexpr int64_t kBlockColumns = 16;
constexpr int64_t kPixelsAtOnce = int64_t(1) << 23;  // bounds the memory

// A view prepared for the tasks: pixels times the distance in mm between planes along their rays, column by column.
template <typename scalar_t>
struct PreparedView {
  const RayView* view;
  std::vector<scalar_t> pixels;              // [u][v]; in upright views v counts as sample of an UprightColumn
  std::vector<int8_t> major;                 // axis, +4 where the ray runs down it; for views that are not upright
  std::vector<scalar_t> start[2], slope[2];  // crossings, likewise
};

template <typename scalar_t>
void prepare_columns(const VoxelProblem& p, const scalar_t* image, int64_t begin, int64_t end,
                     PreparedView<scalar_t>& to) {
  const RayView& view = *to.view;
  if (view.upright) {
    for (int64_t v = 0; v < p.rows; ++v) {
      for (int64_t u = begin; u < end; ++u) to.pixels[u * p.rows + v] = image[v * p.cols + u];
    }
    for (int64_t u = begin; u < end; ++u) {
      const UprightColumn ray(view, u, p.rows, p.counts, p.spacing);
      scalar_t* column = to.pixels.data() + u * p.rows;
      if (ray.flipped) std::reverse(column, column + p.rows);
      for (int64_t n = 0; n < p.rows; ++n) column[n] *= scalar_t(ray.length(n, p.spacing[2]));
    }
    return;
  }
  for (int64_t u = begin; u < end; ++u) {
    for (int64_t v = 0; v < p.rows; ++v) {
      double d[3];
      view.direction(double(u), double(v), d);
      const int axis = RayView::major_axis(d);
      const Crossings crossings = view.crossings(axis, d);
      const int64_t pixel = u * p.rows + v;
      double square = 0;
      for (int k = 0; k < 3; ++k) square += d[k] * p.spacing[k] * d[k] * p.spacing[k];
      to.pixels[pixel] = image[v * p.cols + u] * scalar_t(std::sqrt(square) / std::abs(d[axis]));
      to.major[pixel] = static_cast<int8_t>(axis + (d[axis] > 0 ? 0 : 4));
      for (int k = 0; k < 2; ++k) {
        to.start[k][pixel] = scalar_t(crossings.start[k]);
        to.slope[k][pixel] = scalar_t(crossings.slope[k]);
      }
    }
  }
}

template <typename scalar_t>
struct BackprojectScratch {
  std::vector<scalar_t> samples, sums;

  explicit BackprojectScratch(const VoxelProblem& p)
      : samples(padded_samples(p.rows)), sums(padded_size(p.counts[2])) {}
};

template <typename scalar_t, int L>
TORCHKCREG_INLINE void spread_upright_view(const VoxelProblem& p, const PreparedView<scalar_t>& from, int axis,
                                           PlaneRange block, BackprojectScratch<scalar_t>& scratch,
                                           Lattice<scalar_t>& lattice) {
  const int64_t count_z = p.counts[2];
  scalar_t* samples = scratch.samples.data();
  scalar_t* sums = scratch.sums.data();
  for (int64_t u = 0; u < p.cols; ++u) {
    const UprightColumn ray(*from.view, u, p.rows, p.counts, p.spacing);
    if (ray.axis != axis) continue;
    const int64_t first = std::max(ray.planes.first, block.first), last = std::min(ray.planes.last, block.last);
    if (first > last) continue;
    const scalar_t* pixels = from.pixels.data() + u * p.rows;
    std::copy(pixels, pixels + p.rows, samples);
    for (int64_t plane = first; plane <= last; ++plane) {
      const UprightCrossing at(*from.view, ray, plane, p.counts[ray.other]);
      const double highest = at.start + at.step * double(p.rows - 1);
      if (highest <= -1 || at.start >= double(count_z)) continue;
      const Range reached = whole_vectors<L>(
          {static_cast<int64_t>(std::max(at.start, 0.0)), static_cast<int64_t>(std::min(highest, double(count_z)) + 2)},
          count_z);
      gather_resampled<scalar_t, L>(samples, p.rows, at.start, at.step, reached, sums);
      scalar_t* below = lattice.at(axis == 0 ? plane : at.below, axis == 0 ? at.below : plane, 0);
      add_scaled<scalar_t, L>(sums, scalar_t(1 - at.fraction), reached, below);
      add_scaled<scalar_t, L>(sums, scalar_t(at.fraction), reached, below + lattice.stride(ray.other));
    }
  }
}

// One ray after another; contributions outside the volume go to the frame of the lattice.
template <typename scalar_t>
TORCHKCREG_INLINE void spread_tilted_view(const VoxelProblem& p, const PreparedView<scalar_t>& from, int axis,
                                          PlaneRange block, Lattice<scalar_t>& lattice) {
  const int64_t strides[2] = {lattice.stride(other_axis(axis, 0)), lattice.stride(other_axis(axis, 1))};
  const scalar_t counts[2] = {scalar_t(p.counts[other_axis(axis, 0)]), scalar_t(p.counts[other_axis(axis, 1)])};
  const PlaneRange ahead[2] = {from.view->ahead(axis, 1, p.counts[axis]), from.view->ahead(axis, -1, p.counts[axis])};
  int64_t corner[3] = {-1, -1, -1};
  corner[axis] = 0;
  scalar_t* origin = lattice.at(corner[0], corner[1], corner[2]);
  for (int64_t pixel = 0; pixel < p.pixels(); ++pixel) {
    const int major = from.major[pixel];
    const scalar_t value = from.pixels[pixel];
    if ((major & 3) != axis || value == 0) continue;
    const PlaneRange range = ahead[major >> 2];
    const int64_t first = std::max(range.first, block.first), last = std::min(range.last, block.last);
    bool beside = false;
    for (int k = 0; k < 2; ++k) {
      const scalar_t a = from.start[k][pixel] + from.slope[k][pixel] * scalar_t(first);
      const scalar_t b = from.start[k][pixel] + from.slope[k][pixel] * scalar_t(last);
      beside |= std::max(a, b) <= -1 || std::min(a, b) >= counts[k];
    }
    if (beside) continue;
    for (int64_t plane = first; plane <= last; ++plane) {
      scalar_t fraction[2];
      int64_t offset = plane * lattice.stride(axis);
      for (int k = 0; k < 2; ++k) {
        const scalar_t position = from.start[k][pixel] + from.slope[k][pixel] * scalar_t(plane) + scalar_t(1);
        const scalar_t inside = std::min(std::max(position, scalar_t(0)), counts[k] + scalar_t(1));
        const int64_t below = std::min(static_cast<int64_t>(inside), static_cast<int64_t>(counts[k]));
        fraction[k] = inside - scalar_t(below);
        offset += below * strides[k];
      }
      scalar_t* to = origin + offset;
      const scalar_t low = value * (1 - fraction[1]), high = value * fraction[1];
      to[0] += low * (1 - fraction[0]);
      to[strides[0]] += low * fraction[0];
      to[strides[1]] += high * (1 - fraction[0]);
      to[strides[0] + strides[1]] += high * fraction[0];
    }
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void spread_planes_kernel(const VoxelProblem& p, const std::vector<PreparedView<scalar_t>>& views,
                                            int64_t num_views, int axis, PlaneRange block,
                                            BackprojectScratch<scalar_t>& scratch, Lattice<scalar_t>& lattice) {
  for (int64_t k = 0; k < num_views; ++k) {
    if (!views[k].view->upright) {
      spread_tilted_view(p, views[k], axis, block, lattice);
    } else if (axis != 2) {
      spread_upright_view<scalar_t, L>(p, views[k], axis, block, scratch, lattice);
    }
  }
}

TORCHKCREG_BY_PROCESSOR(float, spread_planes,
                        (const VoxelProblem& p, const std::vector<PreparedView<float>>& views, int64_t num_views,
                         int axis, PlaneRange block, BackprojectScratch<float>& scratch, Lattice<float>& lattice),
                        (p, views, num_views, axis, block, scratch, lattice))
TORCHKCREG_BY_PROCESSOR(double, spread_planes,
                        (const VoxelProblem& p, const std::vector<PreparedView<double>>& views, int64_t num_views,
                         int axis, PlaneRange block, BackprojectScratch<double>& scratch, Lattice<double>& lattice),
                        (p, views, num_views, axis, block, scratch, lattice))

template <typename scalar_t>
void prepare_views(const VoxelProblem& p, int64_t first, int64_t count, const ImageStack<scalar_t>& images,
                   int64_t batch, std::vector<PreparedView<scalar_t>>& prepared) {
  for (int64_t k = 0; k < count; ++k) {
    PreparedView<scalar_t>& to = prepared[k];
    to.view = &p.views[first + k];
    to.pixels.resize(p.pixels());
    if (to.view->upright) continue;
    to.major.resize(p.pixels());
    for (int j = 0; j < 2; ++j) to.start[j].resize(p.pixels()), to.slope[j].resize(p.pixels());
  }
  const int64_t blocks = (p.cols + kBlockColumns - 1) / kBlockColumns;
  torch::stable::parallel_for(0, count * blocks, 1, [&](int64_t begin, int64_t end) {
    for (int64_t t = begin; t < end; ++t) {
      const int64_t u = t % blocks * kBlockColumns;
      prepare_columns(p, images.at(batch, first + t / blocks), u, std::min(u + kBlockColumns, p.cols),
                      prepared[t / blocks]);
    }
  });
}

template <typename scalar_t>
void backproject(const VoxelProblem& p, const ImageStack<scalar_t>& images, scalar_t* volumes) {
  Lattice<scalar_t> lattice(p.counts);
  const int64_t views_at_once = std::min(std::max<int64_t>(kPixelsAtOnce / p.pixels(), 1), p.num_views());
  std::vector<PreparedView<scalar_t>> prepared(views_at_once);
  for (int64_t b = 0; b < p.batch; ++b) {
    if (b > 0) lattice.zero();
    for (int64_t first = 0; first < p.num_views(); first += views_at_once) {
      const int64_t count = std::min(views_at_once, p.num_views() - first);
      prepare_views(p, first, count, images, b, prepared);
      for (int axis = 0; axis < 3; ++axis) {
        const int64_t planes = p.counts[axis], blocks = (planes + kBlockPlanes - 1) / kBlockPlanes;
        torch::stable::parallel_for(0, blocks, 1, [&](int64_t begin, int64_t end) {
          BackprojectScratch<scalar_t> scratch(p);
          for (int64_t t = begin; t < end; ++t) {
            const PlaneRange block{t * kBlockPlanes, std::min((t + 1) * kBlockPlanes, planes) - 1};
            spread_planes(p, prepared, count, axis, block, scratch, lattice);
          }
        });
      }
    }
    lattice.copy_to(volumes + b * p.voxels());
  }
}

using torch::stable::Tensor;

Tensor voxel_backproject(const Tensor& images_, const Tensor& rays, const Tensor& spacing, int64_t depth,
                         int64_t height, int64_t width) {
  check_data(images_, "(B, V, rows, cols)");
  const VoxelProblem p =
      voxel_problem(images_.size(0), depth, height, width, images_.size(2), images_.size(3), rays, spacing);
  STD_TORCH_CHECK(images_.size(1) == p.num_views(), "images must have one view for each matrix");
  const Tensor images = with_contiguous_pixels(images_);
  Tensor volume = torch::stable::new_zeros(images, {p.batch, depth, height, width});
  if (images.scalar_type() == torch::headeronly::ScalarType::Float) {
    backproject(p, ImageStack<float>(images), volume.mutable_data_ptr<float>());
  } else {
    backproject(p, ImageStack<double>(images), volume.mutable_data_ptr<double>());
  }
  return volume;
}

}  // namespace
}  // namespace torchkcreg

STABLE_TORCH_LIBRARY_IMPL(torchkcreg, CPU, m) {
  m.impl("voxel_backproject", TORCH_BOX(&torchkcreg::voxel_backproject));
}
