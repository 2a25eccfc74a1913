// Rays along a detector column or row that is not parallel to z, for views that are not upright. Neighbouring rays
// move together from one lattice plane to the next and lie between few columns of voxels, so each column is read once
// for several rays.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "simd.h"
#include "voxel_lattice.h"
#include "voxel_rays.h"

namespace torchkcreg {
namespace {

// The rays of a line that share a major axis and their sense along it. Other rays copy a neighbour with zero
// weight, so that positions on a plane are monotonic along the line, and the first and last ray of a group bound those
// between.
template <typename scalar_t>
struct RayLine {
  std::vector<scalar_t> start[2], slope[2];  // index along the other axes: start + plane * slope
  std::vector<scalar_t> length;              // millimetres between planes
  std::vector<int8_t> sense;                 // major axis, +4 where the ray runs down it
  int64_t count = 0, begin = 0, end = 0;     // rays; those with weight are among [begin, end)
  int axis = 0;
  PlaneRange planes{0, -1};

  explicit RayLine(int64_t most) : length(most), sense(most) {
    for (int k = 0; k < 2; ++k) start[k].resize(most + kMaxReadAhead), slope[k].resize(most + kMaxReadAhead);
  }

  static TORCHKCREG_INLINE int8_t sense_of(const RayView& view, int64_t line, int64_t n) {
    double d[3];
    direction(view, line, n, d);
    const int major = RayView::major_axis(d);
    return static_cast<int8_t>(major + (d[major] > 0 ? 0 : 4));
  }

  static TORCHKCREG_INLINE void direction(const RayView& view, int64_t line, int64_t n, double* d) {
    view.direction(double(view.lanes_down ? line : n), double(view.lanes_down ? n : line), d);
  }

  TORCHKCREG_INLINE void read_senses(const RayView& view, int64_t line, int64_t rays) {
    count = rays;
    sense[0] = sense_of(view, line, 0);
    if (sense[0] == sense_of(view, line, rays - 1)) {  // the directions with one sense form a convex cone
      std::fill_n(sense.begin(), rays, sense[0]);
    } else {
      for (int64_t n = 1; n < rays; ++n) sense[n] = sense_of(view, line, n);
    }
  }

  // False if no ray has this sense.
  TORCHKCREG_INLINE bool select(const RayView& view, int64_t line, int8_t which, const int64_t* counts,
                                const double* spacing) {
    begin = std::find(sense.begin(), sense.begin() + count, which) - sense.begin();
    if (begin == count) return false;
    end = count;
    while (sense[end - 1] != which) --end;
    axis = which & 3;
    const PlaneRange ahead = view.ahead(axis, which < 4 ? 1 : -1, counts[axis]);
    double lowest = double(ahead.last), highest = double(ahead.first);
    for (int64_t n = begin, member = begin; n < end; ++n) {
      if (sense[n] == which) member = n;
      double d[3], low = double(ahead.first), high = double(ahead.last), square = 0;
      direction(view, line, member, d);
      const double inverse = 1 / d[axis];
      for (int k = 0; k < 2; ++k) {
        const int other = other_axis(axis, k);
        const double slope_ = d[other] * inverse, start_ = view.source[other] - view.source[axis] * slope_;
        start[k][n] = scalar_t(start_), slope[k][n] = scalar_t(slope_);
        const double reciprocal = 1 / (std::abs(slope_) < 1e-9 ? 1e-9 : slope_);
        const double a = (-1 - start_) * reciprocal, b = (double(counts[other]) - start_) * reciprocal;
        low = std::max(low, std::min(a, b)), high = std::min(high, std::max(a, b));
      }
      for (int k = 0; k < 3; ++k) square += d[k] * spacing[k] * d[k] * spacing[k];
      length[n] = sense[n] == which ? scalar_t(std::sqrt(square) * std::abs(inverse)) : scalar_t(0);
      if (low - high > 2) continue;  // misses the volume, with a margin for rounding
      lowest = std::min(lowest, low), highest = std::max(highest, high);
    }
    for (int k = 0; k < 2; ++k) {  // vectors may run over the end
      std::fill_n(start[k].begin() + end, kMaxReadAhead, start[k][end - 1]);
      std::fill_n(slope[k].begin() + end, kMaxReadAhead, slope[k][end - 1]);
    }
    planes.first = std::max(ahead.first, static_cast<int64_t>(std::floor(lowest)));
    planes.last = std::min(ahead.last, static_cast<int64_t>(std::ceil(highest)));
    return true;
  }
};

// Where L rays of a line cross a plane; positions count from the frame.
template <typename scalar_t, int L>
struct LineCrossing {
  using S = Simd<scalar_t, L>;
  typename S::V position[2];
  typename S::I below[2];
  int64_t first[2], last[2];  // of below

  TORCHKCREG_INLINE LineCrossing(const RayLine<scalar_t>& line, int64_t n, int64_t plane, const scalar_t* high) {
    for (int k = 0; k < 2; ++k) {
      const typename S::V at =
          S::load(line.start[k].data() + n) + S::load(line.slope[k].data() + n) * scalar_t(plane) + scalar_t(1);
      position[k] = S::smaller(S::larger(at, S::spread(0)), S::spread(high[k]));
      below[k] = S::truncate(S::smaller(position[k], S::spread(high[k] - 1)));
      const int64_t a = S::lane(below[k], 0), b = S::lane(below[k], L - 1);
      first[k] = std::min(a, b), last[k] = std::max(a, b);
    }
  }

  // True if all rays are in the frame, on one side of the volume.
  TORCHKCREG_INLINE bool beside(const scalar_t* high) const {
    bool result = false;
    for (int k = 0; k < 2; ++k) {
      const scalar_t a = S::lane(position[k], 0), b = S::lane(position[k], L - 1);
      result |= std::max(a, b) <= 0 || std::min(a, b) >= high[k];
    }
    return result;
  }

  // Interpolation weight of column `c` of voxels.
  TORCHKCREG_INLINE typename S::V share(int64_t c) const {
    const typename S::V offset = position[0] - scalar_t(c), one = S::spread(1);
    return S::larger(S::smaller(one + offset, one - offset), S::spread(0));
  }
};

// sums[n] += samples of ray n, plane after plane; may write up to a vector beyond the last.
template <typename scalar_t, int L>
TORCHKCREG_INLINE void add_line(const RayLine<scalar_t>& line, const Lattice<scalar_t>& lattice, const int64_t* counts,
                                scalar_t* sums) {
  using S = Simd<scalar_t, L>;
  using V = typename S::V;
  using I = typename S::I;
  const int axis = line.axis;
  const int64_t across = lattice.stride(other_axis(axis, 0)), along = lattice.stride(other_axis(axis, 1));
  const scalar_t high[2] = {scalar_t(counts[other_axis(axis, 0)] + 1), scalar_t(counts[other_axis(axis, 1)] + 1)};
  for (int64_t plane = line.planes.first; plane <= line.planes.last; ++plane) {
    int64_t corner[3] = {-1, -1, -1};
    corner[axis] = plane;
    const scalar_t* from = lattice.at(corner[0], corner[1], corner[2]);
    for (int64_t n = line.begin; n < line.end; n += L) {
      const LineCrossing<scalar_t, L> at(line, n, plane, high);
      if (at.beside(high)) continue;
      for (const int64_t c : {at.first[0], at.first[0] + 1}) {
        prefetch(from + lattice.stride(axis) + c * across +
                 at.first[1] * along);  // about the same place on the next plane
      }
      const V fraction = at.position[1] - S::number(at.below[1]);
      V sum = S::spread(0);
      if (along == 1 && at.last[1] - at.first[1] + 2 < 2 * L) {
        for (int64_t c = at.first[0]; c <= at.last[0] + 1; ++c) {
          sum += at.share(c) * S::between_near(from + c * across, at.below[1], fraction, at.first[1]);
        }
      } else {
        const I index = at.below[1] * static_cast<typename S::int_t>(along);
        for (int64_t c = at.first[0]; c <= at.last[0] + 1; ++c) {
          const scalar_t* values = from + c * across;
          const V a = S::gather(values, index), b = S::gather(values + along, index);
          sum += at.share(c) * (a + fraction * (b - a));
        }
      }
      S::store(sums + n, S::load(sums + n) + sum);
    }
  }
}

}  // namespace
}  // namespace torchkcreg
