// CPU kernel of cubic B-splines at scattered points, which are sorted by knot cell. Each task handles a run of points.
// Each point has its own sum, so results don't depend on the number of threads.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>

#include "simd.h"

namespace torchkcreg {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

constexpr int64_t kPointsOfTask = 512;
constexpr int kControlPoints = 64;  // of a cell, z offset fastest

template <typename scalar_t>
struct SplineRun {
  const scalar_t *eta, *features;  // of all points (N, 3); of one cell (64, F)
  const int64_t* points;           // the run's
  int64_t count, values;           // of points; F
  int orders[3];                   // of the derivative along each axis
  scalar_t* out;                   // of all points, (N, F)
};

// The four weights of a knot interval, or their derivatives; `bspline_pieces` in Python.
template <typename scalar_t, int L>
TORCHKCREG_INLINE void pieces(typename Simd<scalar_t, L>::V e, int order, typename Simd<scalar_t, L>::V* w) {
  using V = typename Simd<scalar_t, L>::V;
  const V rest = 1 - e, one = Simd<scalar_t, L>::spread(1);
  if (order == 0) {
    const V square = e * e, rest_square = rest * rest;
    w[0] = rest * rest_square * scalar_t(1. / 6);
    w[1] = (3 * e - 6) * square * scalar_t(1. / 6) + scalar_t(2. / 3);
    w[2] = (3 * rest - 6) * rest_square * scalar_t(1. / 6) + scalar_t(2. / 3);
    w[3] = e * square * scalar_t(1. / 6);
  } else if (order == 1) {
    w[0] = rest * rest * scalar_t(-0.5);
    w[1] = (scalar_t(1.5) * e - 2) * e;
    w[2] = (2 - scalar_t(1.5) * rest) * rest;
    w[3] = e * e * scalar_t(0.5);
  } else if (order == 2) {
    w[0] = rest, w[1] = 3 * e - 2, w[2] = 3 * rest - 2, w[3] = e;
  } else {
    const V unit = order == 3 ? one : one * scalar_t(0);
    w[0] = -unit, w[1] = 3 * unit, w[2] = -3 * unit, w[3] = unit;
  }
}

// F values, from the first on, of L points.
template <typename scalar_t, int L, int F>
TORCHKCREG_INLINE void some_values(const SplineRun<scalar_t>& run, const typename Simd<scalar_t, L>::V (&w)[3][4],
                                   int64_t first, const int64_t* points, int64_t lanes) {
  using S = Simd<scalar_t, L>;
  typename S::V sum[F];
  for (int f = 0; f < F; ++f) sum[f] = S::spread(0);
  for (int pair = 0; pair < kControlPoints / 4; ++pair) {
    const typename S::V weight = w[0][pair / 4] * w[1][pair % 4];
    const scalar_t* from = run.features + pair * 4 * run.values + first;
    for (int f = 0; f < F; ++f) {
      const typename S::V along = w[2][0] * from[f] + w[2][1] * from[run.values + f] +
                                  w[2][2] * from[2 * run.values + f] + w[2][3] * from[3 * run.values + f];
      sum[f] += weight * along;
    }
  }
  alignas(64) scalar_t found[F][L];
  for (int f = 0; f < F; ++f) S::store(found[f], sum[f]);
  for (int64_t l = 0; l < lanes; ++l) {
    for (int f = 0; f < F; ++f) run.out[points[l] * run.values + first + f] = found[f][l];
  }
}

template <typename scalar_t, int L>
TORCHKCREG_INLINE void spline_run_kernel(const SplineRun<scalar_t>& run) {
  using S = Simd<scalar_t, L>;
  for (int64_t i = 0; i < run.count; i += L) {
    const int64_t* points = run.points + i;
    const int64_t lanes = std::min<int64_t>(L, run.count - i);
    typename S::V w[3][4];
    for (int axis = 0; axis < 3; ++axis) {
      alignas(64) scalar_t eta[L] = {};
      for (int64_t l = 0; l < lanes; ++l) eta[l] = run.eta[points[l] * 3 + axis];
      pieces<scalar_t, L>(S::load(eta), run.orders[axis], w[axis]);
    }
    int64_t f = 0;
    for (; f + 4 <= run.values; f += 4) some_values<scalar_t, L, 4>(run, w, f, points, lanes);
    if (run.values - f == 3) some_values<scalar_t, L, 3>(run, w, f, points, lanes);
    if (run.values - f == 2) some_values<scalar_t, L, 2>(run, w, f, points, lanes);
    if (run.values - f == 1) some_values<scalar_t, L, 1>(run, w, f, points, lanes);
  }
}

TORCHKCREG_BY_PROCESSOR(float, spline_run, (const SplineRun<float>& run), (run))
TORCHKCREG_BY_PROCESSOR(double, spline_run, (const SplineRun<double>& run), (run))

template <typename scalar_t>
void evaluate(const Tensor& eta, const Tensor& features, const Tensor& order, const Tensor& ends,
              const int (&orders)[3], Tensor& result) {
  const int64_t* points = order.const_data_ptr<int64_t>();
  const int64_t *first = ends.const_data_ptr<int64_t>(), *last = first + ends.size(0);
  const int64_t values = features.size(2);
  SplineRun<scalar_t> all{
      eta.const_data_ptr<scalar_t>(),     nullptr, nullptr, 0, values, {orders[0], orders[1], orders[2]},
      result.mutable_data_ptr<scalar_t>()};
  torch::stable::parallel_for(0, order.size(0), kPointsOfTask, [&](int64_t begin, int64_t end) {
    SplineRun<scalar_t> run = all;
    while (begin < end) {
      const int64_t* cell = std::upper_bound(first, last, begin);
      run.features = features.const_data_ptr<scalar_t>() + (cell - first) * kControlPoints * values;
      run.points = points + begin;
      run.count = std::min(end, *cell) - begin;
      spline_run(run);
      begin += run.count;
    }
  });
}

Tensor spline_evaluate(const Tensor& eta_, const Tensor& features_, const Tensor& order_, const Tensor& ends_,
                       int64_t along_x, int64_t along_y, int64_t along_z) {
  STD_TORCH_CHECK(eta_.dim() == 2 && eta_.size(1) == 3, "eta must have shape (N, 3)");
  STD_TORCH_CHECK(features_.dim() == 3 && features_.size(0) == ends_.size(0) && features_.size(1) == kControlPoints,
                  "features must have shape (cells, 64, F)");
  STD_TORCH_CHECK(order_.dim() == 1 && order_.size(0) == eta_.size(0) && ends_.dim() == 1,
                  "order must name every point, and ends where the cells' points end");
  const ScalarType dtype = eta_.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double, "eta must be float32 or float64");
  STD_TORCH_CHECK(eta_.is_cpu() && features_.is_cpu() && features_.scalar_type() == dtype && order_.is_cpu() &&
                      ends_.is_cpu() && order_.scalar_type() == ScalarType::Long &&
                      ends_.scalar_type() == ScalarType::Long,
                  "tensors must be on the CPU and of one dtype, order and ends of integers");
  const Tensor eta = torch::stable::contiguous(eta_), features = torch::stable::contiguous(features_);
  const Tensor order = torch::stable::contiguous(order_), ends = torch::stable::contiguous(ends_);
  Tensor result = torch::stable::new_empty(eta, {eta.size(0), features.size(2)});
  if (result.numel() == 0) return result;
  const int64_t* last = ends.const_data_ptr<int64_t>();
  STD_TORCH_CHECK(last[ends.size(0) - 1] == order.size(0), "the last cell must end with the last point");
  const int orders[3] = {static_cast<int>(along_x), static_cast<int>(along_y), static_cast<int>(along_z)};
  if (dtype == ScalarType::Float) {
    evaluate<float>(eta, features, order, ends, orders, result);
  } else {
    evaluate<double>(eta, features, order, ends, orders, result);
  }
  return result;
}

}  // namespace
}  // namespace torchkcreg

STABLE_TORCH_LIBRARY_IMPL(torchkcreg, CPU, m) { m.impl("spline_evaluate", TORCH_BOX(&torchkcreg::spline_evaluate)); }
