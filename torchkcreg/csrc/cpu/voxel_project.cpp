// CPU kernel of the voxel projector. Each task computes a block of detector columns (or rows) of a view, and no
// other task writes there, so sums don't depend on the number of threads.
//
// Where detector columns are parallel to z, a whole column of rays crosses each plane between the same two columns of
// voxels: these are blended, and the blend is sampled at equal steps. Otherwise several rays of a line are processed
// together.

#include <torch/csrc/stable/library.h>

#include "voxel_columns.h"
#include "voxel_lattice.h"
#include "voxel_line.h"
#include "voxel_problem.h"

namespace torchkcreg {
namespace {

constexpr int64_t kBlockLines = 16;

template <typename scalar_t>
struct ProjectScratch {
  std::vector<scalar_t> column, sums, along;
  RayLine<scalar_t> line;

  explicit ProjectScratch(const VoxelProblem& p)
      : column(padded_size(p.counts[2])),
        sums(kBlockLines * pitch(p) + kMaxReadAhead),
        along(pitch(p)),
        line(std::max(p.rows, p.cols)) {}
  static int64_t pitch(const VoxelProblem& p) { return std::max(p.rows, p.cols) + kMaxReadAhead; }
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

template <typename scalar_t, int L>
TORCHKCREG_INLINE void project_tilted_line(const VoxelProblem& p, const Lattice<scalar_t>& lattice, const RayView& view,
                                           int64_t number, ProjectScratch<scalar_t>& scratch, scalar_t* sums) {
  RayLine<scalar_t>& line = scratch.line;
  line.read_senses(view, number, view.lanes_down ? p.rows : p.cols);
  std::fill(sums, sums + line.count, scalar_t(0));
  for (const int8_t sense : {0, 1, 2, 4, 5, 6}) {
    if (!line.select(view, number, sense, p.counts, p.spacing)) continue;
    scalar_t* along = scratch.along.data();
    std::fill(along + line.begin, along + line.end, scalar_t(0));
    add_line<scalar_t, L>(line, lattice, p.counts, along);
    for (int64_t n = line.begin; n < line.end; ++n) sums[n] += along[n] * line.length[n];
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void project_block_kernel(const VoxelProblem& p, const Lattice<scalar_t>& lattice,
                                            const RayView& view, int64_t begin, ProjectScratch<scalar_t>& scratch,
                                            scalar_t* image) {
  const int64_t lines = view.lanes_down ? p.cols : p.rows, rays = view.lanes_down ? p.rows : p.cols;
  const int64_t end = std::min(begin + kBlockLines, lines), pitch = ProjectScratch<scalar_t>::pitch(p);
  for (int64_t line = begin; line < end; ++line) {
    scalar_t* sums = scratch.sums.data() + (line - begin) * pitch;
    if (view.upright) {
      project_upright_column<scalar_t, L>(p, lattice, view, line, scratch.column.data() + kColumnPad, sums);
    } else {
      project_tilted_line<scalar_t, L>(p, lattice, view, line, scratch, sums);
    }
  }
  const int64_t next_line = view.lanes_down ? 1 : p.cols, next_ray = view.lanes_down ? p.cols : 1;
  for (int64_t n = 0; n < rays; ++n) {
    for (int64_t line = begin; line < end; ++line) {
      image[line * next_line + n * next_ray] = scratch.sums[(line - begin) * pitch + n];
    }
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
  const int64_t blocks = (std::max(p.cols, p.rows) + kBlockLines - 1) / kBlockLines;
  for (int64_t b = 0; b < p.batch; ++b) {
    lattice.copy_from(volumes + b * p.voxels());
    torch::stable::parallel_for(0, p.num_views() * blocks, 1, [&](int64_t begin, int64_t end) {
      ProjectScratch<scalar_t> scratch(p);
      for (int64_t t = begin; t < end; ++t) {
        scalar_t* image = images + (b * p.num_views() + t / blocks) * p.pixels();
        project_block(p, lattice, p.views[t / blocks], t % blocks * kBlockLines, scratch, image);
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
