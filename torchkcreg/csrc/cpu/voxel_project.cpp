// CPU kernel of the voxel projector. A task is a block of detector columns of a view, and its pixels are its own, so
// sums don't depend on the number of threads.
//
// Where detector columns are parallel to z, a whole column of rays crosses each plane between the same two columns of
// voxels: these are blended, and the blend is sampled at equal steps. Other rays go one by one, some abreast.

#include <torch/csrc/stable/library.h>

#include "voxel_columns.h"
#include "voxel_lattice.h"
#include "voxel_problem.h"

namespace torchkcreg {
namespace {

constexpr int64_t kBlockCols = 16;

template <typename scalar_t>
struct ProjectScratch {
  std::vector<scalar_t> column, sums;

  explicit ProjectScratch(const VoxelProblem& p)
      : column(padded_size(p.counts[2])), sums(kBlockCols * pitch(p) + kMaxReadAhead) {}
  static int64_t pitch(const VoxelProblem& p) { return p.rows + kMaxReadAhead; }
};

template <typename scalar_t, int L>
TORCHKCREG_INLINE void project_upright_column(const VoxelProblem& p, const Lattice<scalar_t>& lattice,
                                              const RayView& view, int64_t u, scalar_t* column, scalar_t* sums) {
  const UprightColumn ray(view, u, p.rows, p.counts, p.spacing);
  const int64_t count_z = p.counts[2];
  std::fill(sums, sums + p.rows, scalar_t(0));
  for (int64_t plane = ray.planes.first; plane <= ray.planes.last; ++plane) {
    const UprightCrossing at(view, ray, plane, p.counts[ray.other]);
    const Range samples = steps_between(at.start, at.step, -1, double(count_z), p.rows);
    if (samples.begin >= samples.end) continue;
    const double lowest = at.start + at.step * double(samples.begin);
    const double highest = at.start + at.step * double(samples.end - 1);
    const Range seen = whole_vectors<L>(
        {static_cast<int64_t>(std::max(lowest, 0.0)), static_cast<int64_t>(std::max(highest, -1.0) + 2)}, count_z);
    const int64_t x = ray.axis == 0 ? plane : at.below, y = ray.axis == 0 ? at.below : plane;
    const scalar_t* below = lattice.at(x, y, 0);
    blend<scalar_t, L>(below, scalar_t(1 - at.fraction), below + lattice.stride(ray.other), scalar_t(at.fraction), seen,
                       column);
    add_resampled<scalar_t, L>(column, count_z, at.start, at.step, samples, sums);
  }
  for (int64_t n = 0; n < p.rows; ++n) sums[n] *= scalar_t(ray.length(n, p.spacing[2]));
  if (ray.flipped) std::reverse(sums, sums + p.rows);
}

// Adds up L rays from (u, v) on that share a major axis and their sense along it.
template <typename scalar_t, int L>
struct RayBundle {
  using S = Simd<scalar_t, L>;
  scalar_t start[2][L], slope[2][L], length[L];
  PlaneRange planes;

  TORCHKCREG_INLINE bool collect(const VoxelProblem& p, const RayView& view, int axis, double sense, int64_t u,
                                 int64_t v) {
    planes = {p.counts[axis], -1};
    for (int l = 0; l < L; ++l) {
      double d[3];
      view.direction(double(u + l), double(v), d);
      const bool member = u + l < p.cols && RayView::major_axis(d) == axis && d[axis] * sense > 0;
      length[l] = 0;
      for (int k = 0; k < 2; ++k) start[k][l] = -1, slope[k][l] = 0;  // in the frame of zeros
      if (!member) continue;
      const Crossings c = view.crossings(axis, d);
      PlaneRange range = view.ahead(axis, sense, p.counts[axis]);
      for (int k = 0; k < 2; ++k) {
        start[k][l] = scalar_t(c.start[k]), slope[k][l] = scalar_t(c.slope[k]);
        narrow(c.start[k], c.slope[k], p.counts[other_axis(axis, k)], range);
      }
      if (range.first > range.last) continue;
      planes = {std::min(planes.first, range.first), std::max(planes.last, range.last)};
      double square = 0;
      for (int k = 0; k < 3; ++k) square += d[k] * p.spacing[k] * d[k] * p.spacing[k];
      length[l] = scalar_t(std::sqrt(square) / std::abs(d[axis]));
    }
    return planes.first <= planes.last;
  }

  TORCHKCREG_INLINE void add(const VoxelProblem& p, const Lattice<scalar_t>& lattice, int axis, scalar_t* sums) const {
    typename S::V start_[2], slope_[2], high[2], sum = S::spread(0);
    int64_t stride[2];
    for (int k = 0; k < 2; ++k) {
      start_[k] = S::load(start[k]) + scalar_t(1);  // positions count from the frame
      slope_[k] = S::load(slope[k]);
      high[k] = S::spread(scalar_t(p.counts[other_axis(axis, k)] + 1));
      stride[k] = lattice.stride(other_axis(axis, k));
    }
    using int_t = typename S::int_t;
    for (int64_t plane = planes.first; plane <= planes.last; ++plane) {
      typename S::I index = S::truncate(S::spread(0));
      typename S::V fraction[2];
      for (int k = 0; k < 2; ++k) {
        const typename S::V position =
            S::smaller(S::larger(start_[k] + slope_[k] * scalar_t(plane), S::spread(0)), high[k]);
        const typename S::I below = S::truncate(S::smaller(position, high[k] - scalar_t(1)));
        fraction[k] = position - S::number(below);
        index += below * static_cast<int_t>(stride[k]);
      }
      int64_t corner[3] = {-1, -1, -1};
      corner[axis] = plane;
      const scalar_t* from = lattice.at(corner[0], corner[1], corner[2]);
      const typename S::V near = S::gather(from, index), next = S::gather(from + stride[0], index);
      const typename S::V far = S::gather(from + stride[1], index);
      const typename S::V farthest = S::gather(from + stride[0] + stride[1], index);
      const typename S::V low = near + fraction[0] * (next - near), up = far + fraction[0] * (farthest - far);
      sum += low + fraction[1] * (up - low);
    }
    S::store(sums, S::load(sums) + sum * S::load(length));
  }
};

template <typename scalar_t, int L>
TORCHKCREG_INLINE void project_block_kernel(const VoxelProblem& p, const Lattice<scalar_t>& lattice,
                                            const RayView& view, int64_t begin, ProjectScratch<scalar_t>& scratch,
                                            scalar_t* image) {
  const int64_t end = std::min(begin + kBlockCols, p.cols), pitch = ProjectScratch<scalar_t>::pitch(p);
  if (view.upright) {
    for (int64_t u = begin; u < end; ++u) {
      project_upright_column<scalar_t, L>(p, lattice, view, u, scratch.column.data() + kColumnPad,
                                          scratch.sums.data() + (u - begin) * pitch);
    }
    for (int64_t v = 0; v < p.rows; ++v) {
      for (int64_t u = begin; u < end; ++u) image[v * p.cols + u] = scratch.sums[(u - begin) * pitch + v];
    }
    return;
  }
  RayBundle<scalar_t, L> bundle;
  scalar_t sums[kBlockCols + L];
  for (int64_t v = 0; v < p.rows; ++v) {
    std::fill(sums, sums + kBlockCols + L, scalar_t(0));
    for (int64_t u = begin; u < end; u += L) {
      for (int axis = 0; axis < 3; ++axis) {
        for (const double sense : {1.0, -1.0}) {
          if (bundle.collect(p, view, axis, sense, u, v)) bundle.add(p, lattice, axis, sums + (u - begin));
        }
      }
    }
    std::copy(sums, sums + (end - begin), image + v * p.cols + begin);
  }
}

TORCHKCREG_BY_PROCESSOR(float, project_block,
                        (const VoxelProblem& p, const Lattice<float>& lattice, const RayView& view, int64_t begin,
                         ProjectScratch<float>& scratch, float* image),
                        (p, lattice, view, begin, scratch, image))
TORCHKCREG_BY_PROCESSOR(double, project_block,
                        (const VoxelProblem& p, const Lattice<double>& lattice, const RayView& view, int64_t begin,
                         ProjectScratch<double>& scratch, double* image),
                        (p, lattice, view, begin, scratch, image))

template <typename scalar_t>
void project(const VoxelProblem& p, const scalar_t* volumes, scalar_t* images) {
  Lattice<scalar_t> lattice(p.counts);
  const int64_t blocks = (p.cols + kBlockCols - 1) / kBlockCols;
  for (int64_t b = 0; b < p.batch; ++b) {
    lattice.copy_from(volumes + b * p.voxels());
    torch::stable::parallel_for(0, p.num_views() * blocks, 1, [&](int64_t begin, int64_t end) {
      ProjectScratch<scalar_t> scratch(p);
      for (int64_t t = begin; t < end; ++t) {
        scalar_t* image = images + (b * p.num_views() + t / blocks) * p.pixels();
        project_block(p, lattice, p.views[t / blocks], t % blocks * kBlockCols, scratch, image);
      }
    });
  }
}

using torch::stable::Tensor;

Tensor voxel_project(const Tensor& volume_, const Tensor& rays, const Tensor& spacing, int64_t rows, int64_t cols) {
  check_data(volume_, "(B, D, H, W)");
  const VoxelProblem p =
      voxel_problem(volume_.size(0), volume_.size(1), volume_.size(2), volume_.size(3), rows, cols, rays, spacing);
  const Tensor volume = torch::stable::contiguous(volume_);
  Tensor images = torch::stable::new_zeros(volume, {p.batch, p.num_views(), rows, cols});
  if (volume.scalar_type() == torch::headeronly::ScalarType::Float) {
    project(p, volume.const_data_ptr<float>(), images.mutable_data_ptr<float>());
  } else {
    project(p, volume.const_data_ptr<double>(), images.mutable_data_ptr<double>());
  }
  return images;
}

}  // namespace
}  // namespace torchkcreg

STABLE_TORCH_LIBRARY_IMPL(torchkcreg, CPU, m) { m.impl("voxel_project", TORCH_BOX(&torchkcreg::voxel_project)); }
