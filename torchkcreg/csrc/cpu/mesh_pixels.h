// Clips a projected triangle to pixels: convex polygons that together make up the triangle.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "dispatch.h"

namespace torchkcreg {
namespace {

// u, v in pixels, pixel (row, col) being [col, col + 1] x [row, row + 1], and w = 1 / depth.
struct Corner {
  double at[3];
};

struct Polygon {
  static constexpr int kMost = 12;  // a triangle cut by four lines has seven corners, more if some coincide
  Corner corners[kMost];
  int side[kMost];  // side of the triangle on which the edge after each corner lies; -1: a pixel's border
  int count = 0;

  TORCHKCREG_INLINE void add(const Corner& corner, int on) {
    corners[count] = corner;
    side[count++] = on;
  }
};

// Splits a polygon at u or v (axis 0 or 1) = line.
TORCHKCREG_INLINE void split(const Polygon& whole, int axis, double line, Polygon& below, Polygon& above) {
  below.count = above.count = 0;
  for (int i = 0; i < whole.count; ++i) {
    const Corner &a = whole.corners[i], &b = whole.corners[i + 1 < whole.count ? i + 1 : 0];
    const double from = a.at[axis] - line, to = b.at[axis] - line;
    (from < 0 ? below : above).add(a, whole.side[i]);
    if ((from < 0) == (to < 0)) continue;
    Corner crossing;
    const double share = from / (from - to);
    for (int k = 0; k < 3; ++k) crossing.at[k] = a.at[k] + share * (b.at[k] - a.at[k]);
    crossing.at[axis] = line;
    // where the outline leaves one half, that half continues along the border, and the other along the edge
    (from < 0 ? below : above).add(crossing, -1);
    (from < 0 ? above : below).add(crossing, whole.side[i]);
  }
}

struct Extent {
  double low, high;
};

TORCHKCREG_INLINE Extent extent(const Polygon& polygon, int axis) {
  Extent e{polygon.corners[0].at[axis], polygon.corners[0].at[axis]};
  for (int i = 1; i < polygon.count; ++i) {
    e.low = std::min(e.low, polygon.corners[i].at[axis]), e.high = std::max(e.high, polygon.corners[i].at[axis]);
  }
  return e;
}

// Finds the pixels of a row that lie wholly inside a triangle: columns [begin, end).
struct Inside {
  double along_u[3], along_v[3], constant[3], inverse[3];  // edge functions, positive inside
  bool flat;

  TORCHKCREG_INLINE explicit Inside(const Polygon& triangle) {
    const Corner* c = triangle.corners;
    const double area =
        (c[1].at[0] - c[0].at[0]) * (c[2].at[1] - c[0].at[1]) - (c[1].at[1] - c[0].at[1]) * (c[2].at[0] - c[0].at[0]);
    const double sense = area > 0 ? 1 : -1;
    flat = std::abs(area) < 2;  // too small to contain a pixel, or seen edge-on
    for (int i = 0; i < 3 && !flat; ++i) {
      const Corner &a = c[i], &b = c[(i + 1) % 3];
      along_u[i] = -sense * (b.at[1] - a.at[1]), along_v[i] = sense * (b.at[0] - a.at[0]);
      constant[i] = -along_u[i] * a.at[0] - along_v[i] * a.at[1];
      inverse[i] = along_u[i] == 0 ? 0 : 1 / along_u[i];
    }
  }

  TORCHKCREG_INLINE void columns(int64_t row, int64_t& begin, int64_t& end) const {
    if (flat) end = begin;
    for (int i = 0; i < 3 && begin < end; ++i) {
      const double least = along_v[i] * double(row) + std::min(along_v[i], 0.0) + constant[i];  // at u = 0
      if (along_u[i] == 0) {
        if (least <= 0) end = begin;
        continue;
      }
      const double limit = -least * inverse[i];
      if (along_u[i] > 0) {
        if (limit >= double(begin)) begin = static_cast<int64_t>(std::min(limit, double(end))) + 1;
      } else {
        end = static_cast<int64_t>(std::floor(std::min(std::max(limit, double(begin)), double(end))));
      }
    }
  }
};

// Calls `part(row, col, polygon)` for pixels that a triangle's outline cuts and `whole(row, begin, end)` for runs of
// pixels inside it, of rows [first, last) and columns [0, cols). An edge on the border of two pixels counts for the
// second one, for both triangles that share it. Otherwise the gradient would miss that, when the edge moves, one
// triangle gains what the other loses.
template <typename Part, typename Whole>
TORCHKCREG_INLINE void each_pixel(const Polygon& triangle, int64_t first, int64_t last, int64_t cols, const Part& part,
                                  const Whole& whole) {
  const Extent v = extent(triangle, 1), u = extent(triangle, 0);
  if (!(v.high >= double(first) && v.low < double(last) && u.high >= 0 && u.low < double(cols))) return;
  const Inside inside(triangle);
  Polygon rest = triangle, row, left, right;
  if (v.low < double(first)) {
    split(triangle, 1, double(first), row, rest);
  } else {
    first = static_cast<int64_t>(v.low);
  }
  for (int64_t r = first; r < last && rest.count > 2; ++r) {
    const bool ends = v.high < double(r + 1);
    if (ends) {
      row = rest, rest.count = 0;
    } else {
      Polygon all = rest;
      split(all, 1, double(r + 1), row, rest);
    }
    if (row.count < 3) continue;
    const Extent across = extent(row, 0);
    if (!(across.high >= 0 && across.low < double(cols))) continue;
    int64_t c = 0;
    if (across.low < 0) {
      split(row, 0, 0, left, right);
      row = right;
    } else {
      c = static_cast<int64_t>(across.low);
    }
    int64_t begin = c, end = std::min(static_cast<int64_t>(across.high), cols);
    inside.columns(r, begin, end);
    while (c < cols && row.count > 2) {
      int64_t next = c + 1;
      if (c == begin && begin < end) next = end;
      if (across.high < double(next) && next == c + 1) {
        part(r, c, row);
        break;
      }
      split(row, 0, double(next), left, right);
      if (c == begin && begin < end) {
        whole(r, begin, end);
      } else if (left.count > 2) {
        part(r, c, left);
      }
      row = right;
      c = next;
    }
  }
}

}  // namespace
}  // namespace torchkcreg
