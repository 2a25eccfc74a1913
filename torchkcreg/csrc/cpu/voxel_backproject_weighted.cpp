// CPU kernel of FDK's back-projection: each voxel samples the filtered images at its projection, divided by the
// squared depth. Each task handles a few rows of voxel columns, view after view, so the order of sums is fixed.
//
// Where detector columns are parallel to z, a column of voxels lies between two detector columns at a constant depth:
// these are blended, and the blend is sampled at equal steps. Otherwise several voxels of a column are processed
// together.

#include <torch/csrc/stable/library.h>

#include "voxel_columns.h"
#include "voxel_lattice.h"
#include "voxel_problem.h"

namespace torchkcreg {
namespace {

constexpr int64_t kBlockRows = 4;
constexpr int64_t kBlockColumns = 16;
constexpr int64_t kPixelsAtOnce = int64_t(1) << 23;  // bounds the memory

struct PixelView {
  double matrix[3][4];  // voxel index to homogeneous pixel
  bool upright, flipped;
};

struct WeightedProblem {
  int64_t batch, rows, cols;
  int64_t counts[3];
  std::vector<PixelView> views;

  int64_t num_views() const { return static_cast<int64_t>(views.size()); }
  int64_t pixels() const { return rows * cols; }
  // Images are kept column by column in a frame of zeros.
  int64_t pitch() const { return rows + 2; }
  int64_t framed() const { return pitch() * (cols + 2); }
};

inline PixelView read_pixel_view(const double* matrix, const int64_t* counts, int64_t rows) {
  PixelView view;
  for (int k = 0; k < 12; ++k) view.matrix[k / 4][k % 4] = matrix[k];
  // Along a column of voxels u changes by d(P0/P2), and v is nonlinear by as much as the depth changes; both roughly in
  // pixels.
  const auto& m = view.matrix;
  const double depth = std::abs(m[2][3] + (m[2][0] * double(counts[0]) + m[2][1] * double(counts[1])) / 2);
  const double pixels = double(rows) + std::abs(m[1][3]) / std::max(depth, 1e-300);
  const double wide = double(rows) + std::abs(m[0][3]) / std::max(depth, 1e-300);
  const double drift = (std::abs(m[0][2]) + std::abs(m[2][2]) * std::max(wide, pixels)) * double(counts[2]);
  view.upright = drift < 1e-5 * depth;
  view.flipped = m[1][2] < 0;
  return view;
}

template <typename scalar_t>
void frame_columns(const WeightedProblem& p, const PixelView& view, const scalar_t* image, int64_t begin, int64_t end,
                   scalar_t* framed) {
  for (int64_t v = 0; v < p.rows; ++v) {
    const int64_t row = view.upright && view.flipped ? p.rows - 1 - v : v;
    for (int64_t u = begin; u < end; ++u) framed[(u + 1) * p.pitch() + row + 1] = image[v * p.cols + u];
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void add_upright_column(const WeightedProblem& p, const PixelView& view, const scalar_t* framed,
                                          int64_t x, int64_t y, scalar_t* blended, scalar_t* sums) {
  double h[3];
  for (int k = 0; k < 3; ++k) {
    h[k] = view.matrix[k][0] * double(x) + view.matrix[k][1] * double(y) +
           view.matrix[k][2] * (k == 1 ? 0 : double(p.counts[2] - 1) / 2) + view.matrix[k][3];
  }
  if (!(h[2] > 0)) return;
  const double weight = 1 / (h[2] * h[2]), u = h[0] / h[2] + 1;  // u, v include the frame
  if (!(u > 0 && u < double(p.cols + 1))) return;
  const double bottom = h[1] / h[2], step = std::abs(view.matrix[1][2] / h[2]);
  const double start = view.flipped ? double(p.rows - 1) - bottom : bottom;
  if (step < 1e-12) return;  // a view along z is not upright, this only guards the division
  const Range voxels = steps_between(start, step, -1, double(p.rows), p.counts[2]);
  if (voxels.begin >= voxels.end) return;
  const double lowest = start + step * double(voxels.begin), highest = start + step * double(voxels.end - 1);
  const Range seen = whole_vectors<L>(
      {static_cast<int64_t>(std::max(lowest, 0.0)), static_cast<int64_t>(std::max(highest, -1.0) + 2)}, p.rows);
  const int64_t col = static_cast<int64_t>(u);
  const double fraction = u - double(col);
  const scalar_t* left = framed + col * p.pitch() + 1;
  blend<scalar_t, L>(left, scalar_t(weight * (1 - fraction)), left + p.pitch(), scalar_t(weight * fraction), seen,
                     blended);
  add_resampled<scalar_t, L>(blended, p.rows, start, step, voxels, sums);
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void add_tilted_column(const WeightedProblem& p, const PixelView& view, const scalar_t* framed,
                                         int64_t x, int64_t y, scalar_t* sums) {
  using S = Simd<scalar_t, L>;
  using V = typename S::V;
  using I = typename S::I;
  double h[3];
  for (int k = 0; k < 3; ++k) {
    h[k] = view.matrix[k][0] * double(x) + view.matrix[k][1] * double(y) + view.matrix[k][3];
  }
  const V zero = S::spread(0), one = S::spread(1), ramp = S::ramp();
  const V last_u = S::spread(scalar_t(p.cols + 1)), last_v = S::spread(scalar_t(p.rows + 1));
  for (int64_t z = 0; z < p.counts[2]; z += L) {
    V at[3];
    for (int k = 0; k < 3; ++k) {
      at[k] = ramp * scalar_t(view.matrix[k][2]) + scalar_t(h[k] + view.matrix[k][2] * double(z));
    }
    const V inverse = at[2] > zero ? one / at[2] : zero;  // zero weight behind the source
    const V u = S::smaller(S::larger(at[0] * inverse + one, zero), last_u);
    const V v = S::smaller(S::larger(at[1] * inverse + one, zero), last_v);
    const I col = S::truncate(S::smaller(u, last_u - one)), row = S::truncate(S::smaller(v, last_v - one));
    const V fraction_u = u - S::number(col), fraction_v = v - S::number(row);
    const I index = col * static_cast<typename S::int_t>(p.pitch()) + row;
    const V a = S::gather(framed, index), b = S::gather(framed + 1, index);
    const V c = S::gather(framed + p.pitch(), index), d = S::gather(framed + p.pitch() + 1, index);
    const V left = a + fraction_v * (b - a), right = c + fraction_v * (d - c);
    S::store(sums + z, S::load(sums + z) + inverse * inverse * (left + fraction_u * (right - left)));
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void add_view_kernel(const WeightedProblem& p, const PixelView& view, const scalar_t* framed,
                                       int64_t first_y, int64_t last_y, scalar_t* blended, scalar_t* sums,
                                       int64_t pitch) {
  for (int64_t y = first_y; y < last_y; ++y) {
    for (int64_t x = 0; x < p.counts[0]; ++x) {
      scalar_t* column = sums + ((y - first_y) * p.counts[0] + x) * pitch;
      if (view.upright) {
        add_upright_column<scalar_t, L>(p, view, framed, x, y, blended, column);
      } else {
        add_tilted_column<scalar_t, L>(p, view, framed, x, y, column);
      }
    }
  }
}

TORCHKCREG_BY_PROCESSOR(float, add_view,
                        (const WeightedProblem& p, const PixelView& view, const float* framed, int64_t first_y,
                         int64_t last_y, float* blended, float* sums, int64_t pitch),
                        (p, view, framed, first_y, last_y, blended, sums, pitch))
TORCHKCREG_BY_PROCESSOR(double, add_view,
                        (const WeightedProblem& p, const PixelView& view, const double* framed, int64_t first_y,
                         int64_t last_y, double* blended, double* sums, int64_t pitch),
                        (p, view, framed, first_y, last_y, blended, sums, pitch))

// Adds some views to the volume (z, y, x).
template <typename scalar_t>
void add_views(const WeightedProblem& p, int64_t first, int64_t count, const std::vector<scalar_t>& framed,
               scalar_t* volume) {
  const int64_t nx = p.counts[0], ny = p.counts[1], nz = p.counts[2];
  const int64_t blocks = (ny + kBlockRows - 1) / kBlockRows;
  // Vectors may run over the end of a column, and an odd number of cache lines keeps columns apart in caches.
  constexpr int64_t kLine = 64 / sizeof(scalar_t);
  const int64_t pitch = ((nz + kLine - 1) / kLine | 1) * kLine;
  torch::stable::parallel_for(0, blocks, 1, [&](int64_t begin, int64_t end) {
    std::vector<scalar_t> blended(padded_size(p.rows)), sums(kBlockRows * nx * pitch + kMaxReadAhead);
    for (int64_t t = begin; t < end; ++t) {
      const int64_t y0 = t * kBlockRows, y1 = std::min(y0 + kBlockRows, ny);
      std::fill(sums.begin(), sums.end(), scalar_t(0));
      for (int64_t k = 0; k < count; ++k) {
        add_view(p, p.views[first + k], framed.data() + k * p.framed(), y0, y1, blended.data() + kColumnPad,
                 sums.data(), pitch);
      }
      for (int64_t z = 0; z < nz; ++z) {
        for (int64_t y = y0; y < y1; ++y) {
          const scalar_t* from = sums.data() + (y - y0) * nx * pitch + z;
          for (int64_t x = 0; x < nx; ++x) volume[(z * ny + y) * nx + x] += from[x * pitch];
        }
      }
    }
  });
}

template <typename scalar_t>
void backproject_weighted(const WeightedProblem& p, const ImageStack<scalar_t>& images, scalar_t* volumes) {
  const int64_t views_at_once = std::min(std::max<int64_t>(kPixelsAtOnce / p.pixels(), 1), p.num_views());
  const int64_t blocks = (p.cols + kBlockColumns - 1) / kBlockColumns;
  std::vector<scalar_t> framed(views_at_once * p.framed() + kMaxReadAhead);
  for (int64_t b = 0; b < p.batch; ++b) {
    for (int64_t first = 0; first < p.num_views(); first += views_at_once) {
      const int64_t count = std::min(views_at_once, p.num_views() - first);
      torch::stable::parallel_for(0, count * blocks, 1, [&](int64_t begin, int64_t end) {
        for (int64_t t = begin; t < end; ++t) {
          const int64_t k = t / blocks, u = t % blocks * kBlockColumns;
          frame_columns(p, p.views[first + k], images.at(b, first + k), u, std::min(u + kBlockColumns, p.cols),
                        framed.data() + k * p.framed());
        }
      });
      add_views(p, first, count, framed, volumes + b * p.counts[0] * p.counts[1] * p.counts[2]);
    }
  }
}

using torch::stable::Tensor;

Tensor voxel_backproject_weighted(const Tensor& images_, const Tensor& matrices_, int64_t depth, int64_t height,
                                  int64_t width) {
  check_data(images_, "(B, V, rows, cols)");
  const Tensor images = with_contiguous_pixels(images_), matrices = check_matrices(matrices_);
  STD_TORCH_CHECK(images.size(1) == matrices.size(0), "images must have one view for each matrix");
  WeightedProblem p{images.size(0), images.size(2), images.size(3), {width, height, depth}, {}};
  check_sizes(p.counts, p.rows, p.cols);
  for (int64_t v = 0; v < matrices.size(0); ++v) {
    p.views.push_back(read_pixel_view(matrices.const_data_ptr<double>() + 12 * v, p.counts, p.rows));
  }
  Tensor volume = torch::stable::new_zeros(images, {p.batch, depth, height, width});
  if (images.scalar_type() == torch::headeronly::ScalarType::Float) {
    backproject_weighted(p, ImageStack<float>(images), volume.mutable_data_ptr<float>());
  } else {
    backproject_weighted(p, ImageStack<double>(images), volume.mutable_data_ptr<double>());
  }
  return volume;
}

}  // namespace
}  // namespace torchkcreg

STABLE_TORCH_LIBRARY_IMPL(torchkcreg, CPU, m) {
  m.impl("voxel_backproject_weighted", TORCH_BOX(&torchkcreg::voxel_backproject_weighted));
}
