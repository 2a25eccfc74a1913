// The rays of a view in voxel indices, and the lattice planes on which they are sampled; projector/voxel_reference.py
// defines what the kernels compute.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "dispatch.h"

namespace torchkcreg {
namespace {  // compiled into each file by itself, and kept out of the library's symbols

// Planes first to last (inclusive) of an axis.
struct PlaneRange {
  int64_t first, last;
};

// A ray that advances by one plane of an axis at a time: the other indices are start + plane * slope.
struct Crossings {
  double start[2], slope[2];
};

inline int other_axis(int axis, int which) { return which == 0 ? (axis == 0 ? 1 : 0) : (axis == 2 ? 1 : 2); }

struct RayView {
  double directions[3][3];  // ray of pixel (u, v): directions (u, v, 1)
  double source[3];
  bool upright;     // detector columns are parallel to z: along one, rays share their way in x and y
  bool lanes_down;  // of columns and rows, columns are closer to z

  TORCHKCREG_INLINE void direction(double u, double v, double* d) const {
    for (int k = 0; k < 3; ++k) d[k] = directions[k][0] * u + directions[k][1] * v + directions[k][2];
  }

  static TORCHKCREG_INLINE int major_axis(const double* d) {
    // At 45 degrees rounding must not decide.
    const double x = std::abs(d[0]), y = std::abs(d[1]) * (1 - 1e-6), z = std::abs(d[2]) * (1 - 2e-6);
    return x >= y ? (x >= z ? 0 : 2) : (y >= z ? 1 : 2);
  }

  // Planes that lie ahead of the source, among count of them.
  TORCHKCREG_INLINE PlaneRange ahead(int axis, double step, int64_t count) const {
    const double s = source[axis];
    if (step > 0) return {s < 0 ? 0 : static_cast<int64_t>(std::min(std::floor(s) + 1, double(count))), count - 1};
    return {0, s > double(count - 1) ? count - 1 : static_cast<int64_t>(std::max(std::ceil(s) - 1, -1.0))};
  }

  TORCHKCREG_INLINE Crossings crossings(int axis, const double* d) const {
    Crossings c;
    for (int k = 0; k < 2; ++k) {
      const int other = other_axis(axis, k);
      c.slope[k] = d[other] / d[axis];
      c.start[k] = source[other] - source[axis] * c.slope[k];
    }
    return c;
  }
};

// Keeps the planes where start + plane * slope is between -1 and count, to within one plane.
TORCHKCREG_INLINE void narrow(double start, double slope, int64_t count, PlaneRange& range) {
  if (std::abs(slope) < 1e-9) {
    if (start <= -1 || start >= double(count)) range.last = range.first - 1;
    return;
  }
  const double a = (-1 - start) / slope, b = (double(count) - start) / slope;
  const double low = std::max(std::min(a, b), double(range.first) - 1);
  const double high = std::min(std::max(a, b), double(range.last) + 1);
  range.first = std::max<int64_t>(range.first, static_cast<int64_t>(std::floor(low)));
  range.last = std::min<int64_t>(range.last, static_cast<int64_t>(std::ceil(high)));
}

// A detector column of an upright view: rays that share their way in x and y and climb evenly. Sample n is row n, or
// row rows - 1 - n where z falls with the row.
struct UprightColumn {
  int axis, other;
  bool flipped;
  double step;               // of depth from plane to plane
  double climb, climb_step;  // dz at depth 1 of sample 0, and from sample to sample (positive)
  double start, slope;       // index along the other axis: start + plane * slope
  double flat;               // squared length of the ray at depth 1 without its z component, in mm^2
  PlaneRange planes;

  UprightColumn(const RayView& view, int64_t u, int64_t rows, const int64_t* counts, const double* spacing) {
    double d[3];
    view.direction(double(u), double(rows - 1) / 2, d);
    axis = std::abs(d[0]) >= std::abs(d[1]) * (1 - 1e-6) ? 0 : 1;
    other = 1 - axis;
    step = d[axis];
    const double per_row = view.directions[2][1], half = double(rows - 1) / 2;
    flipped = per_row < 0;
    climb_step = std::abs(per_row);
    climb = d[2] - half * climb_step;
    slope = d[other] / d[axis];
    start = view.source[other] - view.source[axis] * slope;
    flat = d[0] * d[0] * spacing[0] * spacing[0] + d[1] * d[1] * spacing[1] * spacing[1];
    planes = view.ahead(axis, step, counts[axis]);
    narrow(start, slope, counts[other], planes);
  }

  // Millimetres between two planes, along the ray of sample n.
  TORCHKCREG_INLINE double length(int64_t n, double spacing_z) const {
    const double dz = (climb + climb_step * double(n)) * spacing_z;
    return std::sqrt(flat + dz * dz) / std::abs(step);
  }
};

// Where an upright column crosses a plane: between columns `below` and `below` + 1 of voxels, at z of start + n * step.
struct UprightCrossing {
  int64_t below;
  double fraction, start, step;

  TORCHKCREG_INLINE UprightCrossing(const RayView& view, const UprightColumn& column, int64_t plane, int64_t count) {
    const double position = std::min(std::max(column.start + double(plane) * column.slope, -1.0), double(count));
    below = std::min(static_cast<int64_t>(position + 1), count) - 1;
    fraction = position - double(below);
    const double depth = (double(plane) - view.source[column.axis]) / column.step;
    start = view.source[2] + depth * column.climb;
    step = depth * column.climb_step;
  }
};

// Reads a matrix [D | s] of 3 x 4.
inline RayView read_view(const double* matrix, const int64_t* counts, int64_t rows, int64_t cols) {
  RayView view;
  for (int k = 0; k < 3; ++k) {
    for (int j = 0; j < 3; ++j) view.directions[k][j] = matrix[4 * k + j];
    view.source[k] = matrix[4 * k + 3];
  }
  // Largest depth of a voxel from the source, from the third row of the inverse (|offset| over the shortest |d| would
  // also bound it).
  const auto& d = view.directions;
  const double cofactors[3] = {d[1][0] * d[2][1] - d[1][1] * d[2][0], d[0][1] * d[2][0] - d[0][0] * d[2][1],
                               d[0][0] * d[1][1] - d[0][1] * d[1][0]};
  const double determinant = cofactors[0] * d[0][2] + cofactors[1] * d[1][2] + cofactors[2] * d[2][2];
  double depth = 0;
  for (int k = 0; k < 3; ++k) {
    const double reach = std::max(std::abs(view.source[k]), std::abs(double(counts[k]) - view.source[k]));
    depth += std::abs(cofactors[k] / determinant) * reach;
  }
  const double drift = std::max(std::abs(d[0][1]), std::abs(d[1][1])) * depth * double(rows);
  const auto lies = [&](int j) { return std::hypot(d[0][j], d[1][j]) * std::abs(d[2][1 - j]); };
  view.lanes_down = lies(1) <= lies(0);
  view.upright = drift < 1e-4;  // voxels, between the ends of a column
  for (int64_t u = 0; u < cols && view.upright; ++u) {
    for (const int64_t v : {int64_t(0), rows - 1}) {  // where rays are steepest
      double ray[3];
      view.direction(double(u), double(v), ray);
      if (RayView::major_axis(ray) == 2) view.upright = false;
    }
  }
  return view;
}

}  // namespace
}  // namespace torchkcreg
