// CPU kernel of the mesh projector: signed depths of projected triangles, integrated over each pixel, and the gradient.
// Each task handles a band of image rows and loops over the triangles in order, so sums don't depend on the number of
// threads.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <vector>

#include "mesh_pixels.h"

namespace torchkcreg {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

constexpr int64_t kRowsOfTask = 32;

struct MeshProblem {
  const double* corners;  // (images, vertices, 3)
  const int64_t* faces;   // (triangles, 3)
  int64_t images, vertices, triangles, rows, cols;

  int64_t bands() const { return (rows + kRowsOfTask - 1) / kRowsOfTask; }
  TORCHKCREG_INLINE Polygon triangle(int64_t image, int64_t number) const {
    Polygon polygon;
    for (int i = 0; i < 3; ++i) {
      Corner corner;
      std::copy_n(corners + (image * vertices + faces[3 * number + i]) * 3, 3, corner.at);
      polygon.add(corner, i);
    }
    return polygon;
  }
};

// Twice the signed area.
TORCHKCREG_INLINE double doubled(const Corner& a, const Corner& b, const Corner& c) {
  return (b.at[0] - a.at[0]) * (c.at[1] - a.at[1]) - (b.at[1] - a.at[1]) * (c.at[0] - a.at[0]);
}

// The mean of 1 / w over a triangle on which it is affine; `_mean_reciprocal` in Python.
TORCHKCREG_INLINE double mean_reciprocal(double a, double b, double c) {
  const double inverse = 3 / (a + b + c);
  a = a * inverse - 1, b = b * inverse - 1, c = c * inverse - 1;
  const double pairs = a * b + a * c + b * c, product = a * b * c;
  return (1 - pairs / 6 - product / 10 + pairs * pairs / 15) * inverse;
}

TORCHKCREG_INLINE double integral(const Polygon& polygon) {
  double sum = 0;
  const Corner& first = polygon.corners[0];
  for (int i = 1; i + 1 < polygon.count; ++i) {
    const Corner &b = polygon.corners[i], &c = polygon.corners[i + 1];
    sum += doubled(first, b, c) / 2 * mean_reciprocal(first.at[2], b.at[2], c.at[2]);
  }
  return sum;
}

// Affine functions of u and v on a triangle: w, and the three that are one at a corner and zero at the others.
struct Planes {
  double along_u[3], along_v[3], constant[3];  // the latter
  double slope_u, slope_v, w;                  // of w, and w at the origin
  double sense;

  TORCHKCREG_INLINE explicit Planes(const Polygon& t) {
    const double area = doubled(t.corners[0], t.corners[1], t.corners[2]), inverse = area == 0 ? 0 : 1 / area;
    sense = area > 0 ? 1 : area < 0 ? -1 : 0;
    slope_u = slope_v = w = 0;
    for (int i = 0; i < 3; ++i) {
      const double *b = t.corners[(i + 1) % 3].at, *c = t.corners[(i + 2) % 3].at;
      along_u[i] = (b[1] - c[1]) * inverse, along_v[i] = (c[0] - b[0]) * inverse;
      constant[i] = (b[0] * c[1] - c[0] * b[1]) * inverse;
      slope_u += along_u[i] * t.corners[i].at[2], slope_v += along_v[i] * t.corners[i].at[2];
      w += constant[i] * t.corners[i].at[2];
    }
  }
  TORCHKCREG_INLINE double share(int i, double u, double v) const {
    return constant[i] + along_u[i] * u + along_v[i] * v;
  }
};

TORCHKCREG_MULTIVERSION void add_band(const MeshProblem& p, int64_t image, int64_t first, int64_t last,
                                      double* pixels) {
  for (int64_t number = 0; number < p.triangles; ++number) {
    const Polygon triangle = p.triangle(image, number);
    const auto part = [&](int64_t row, int64_t col, const Polygon& polygon) {
      pixels[row * p.cols + col] += integral(polygon);
    };
    const auto whole = [&](int64_t row, int64_t begin, int64_t end) {
      const Planes planes(triangle);
      const double variance = (planes.slope_u * planes.slope_u + planes.slope_v * planes.slope_v) / 12;
      const double start = planes.w + planes.slope_v * (double(row) + 0.5);
      for (int64_t col = begin; col < end; ++col) {
        const double inverse = 1 / (start + planes.slope_u * (double(col) + 0.5));
        pixels[row * p.cols + col] += planes.sense * inverse * (1 + variance * inverse * inverse);
      }
    };
    each_pixel(triangle, first, last, p.cols, part, whole);
  }
}

// Derivative, with respect to a triangle's corners, of the sum over its pixels of gradient times integral: the outline
// sweeps area (Reynolds transport theorem), and 1 / w changes inside.
struct CornerGradients {
  double shares[3] = {0, 0, 0};  // -integral of share / w^2: to the corners' w
  double outline[3][2] = {{0, 0}, {0, 0}, {0, 0}};

  TORCHKCREG_INLINE void add_inside(const Planes& planes, double u, double v, double weight, double w) {
    for (int i = 0; i < 3; ++i) shares[i] -= weight * planes.share(i, u, v) / (w * w);
  }

  TORCHKCREG_INLINE void add_part(const Planes& planes, const Polygon& polygon, double gradient) {
    const Corner& a = polygon.corners[0];
    for (int i = 1; i + 1 < polygon.count; ++i) {  // the midpoints of the edges integrate quadratic functions exactly
      const Corner &b = polygon.corners[i], &c = polygon.corners[i + 1];
      const double weight = gradient * doubled(a, b, c) / 6;
      const Corner* edges[3][2] = {{&a, &b}, {&b, &c}, {&c, &a}};
      for (const auto& edge : edges) {
        double middle[3];
        for (int k = 0; k < 3; ++k) middle[k] = (edge[0]->at[k] + edge[1]->at[k]) / 2;
        add_inside(planes, middle[0], middle[1], weight, middle[2]);
      }
    }
    for (int i = 0; i < polygon.count; ++i) {
      const int side = polygon.side[i];
      if (side < 0) continue;
      const Corner &from = polygon.corners[i], &to = polygon.corners[i + 1 < polygon.count ? i + 1 : 0];
      const double du = to.at[0] - from.at[0], dv = to.at[1] - from.at[1];
      constexpr double kGauss = 0.28867513459481287;
      for (const double t : {0.5 - kGauss, 0.5 + kGauss}) {
        const double u = from.at[0] + t * du, v = from.at[1] + t * dv;
        const double flux = gradient / 2 / (from.at[2] + t * (to.at[2] - from.at[2]));
        for (const int end : {side, side == 2 ? 0 : side + 1}) {
          const double share = planes.share(end, u, v);
          outline[end][0] += flux * share * dv, outline[end][1] -= flux * share * du;
        }
      }
    }
  }
};

TORCHKCREG_MULTIVERSION void add_band_gradient(const MeshProblem& p, int64_t image, int64_t first, int64_t last,
                                               const double* gradient, double* to_corners) {
  for (int64_t number = 0; number < p.triangles; ++number) {
    const Polygon triangle = p.triangle(image, number);
    const Planes planes(triangle);
    if (planes.sense == 0) continue;  // a face seen edge-on has zero area
    CornerGradients sums;
    bool any = false;
    const auto part = [&](int64_t row, int64_t col, const Polygon& polygon) {
      sums.add_part(planes, polygon, gradient[row * p.cols + col]);
      any = true;
    };
    const auto whole = [&](int64_t row, int64_t begin, int64_t end) {
      constexpr double kGauss = 0.28867513459481287;
      for (int64_t col = begin; col < end; ++col) {
        const double weight = gradient[row * p.cols + col] * planes.sense / 4;
        for (const double i : {0.5 - kGauss, 0.5 + kGauss}) {
          for (const double j : {0.5 - kGauss, 0.5 + kGauss}) {
            const double u = double(col) + i, v = double(row) + j;
            sums.add_inside(planes, u, v, weight, planes.w + planes.slope_u * u + planes.slope_v * v);
          }
        }
      }
      any = true;
    };
    each_pixel(triangle, first, last, p.cols, part, whole);
    if (!any) continue;
    for (int i = 0; i < 3; ++i) {  // a moving corner keeps its w: at the old position, w decreases by the slope
      double* to = to_corners + p.faces[3 * number + i] * 3;
      to[0] += sums.outline[i][0] - sums.shares[i] * planes.slope_u;
      to[1] += sums.outline[i][1] - sums.shares[i] * planes.slope_v;
      to[2] += sums.shares[i];
    }
  }
}

MeshProblem mesh_problem(const Tensor& corners, const Tensor& faces, int64_t rows, int64_t cols) {
  STD_TORCH_CHECK(corners.dim() == 3 && corners.size(2) == 3, "corners must have shape (B, n, 3)");
  STD_TORCH_CHECK(faces.dim() == 2 && faces.size(1) == 3, "faces must have shape (m, 3)");
  STD_TORCH_CHECK(corners.is_cpu() && corners.scalar_type() == ScalarType::Double,
                  "corners must be float64 on the CPU");
  STD_TORCH_CHECK(faces.is_cpu() && faces.scalar_type() == ScalarType::Long, "faces must be integers on the CPU");
  STD_TORCH_CHECK(rows > 0 && cols > 0, "images must have pixels");
  const MeshProblem p{corners.const_data_ptr<double>(),
                      faces.const_data_ptr<int64_t>(),
                      corners.size(0),
                      corners.size(1),
                      faces.size(0),
                      rows,
                      cols};
  for (int64_t i = 0; i < 3 * p.triangles; ++i) {
    STD_TORCH_CHECK(p.faces[i] >= 0 && p.faces[i] < p.vertices, "faces must index vertices");
  }
  return p;
}

Tensor mesh_lengths(const Tensor& corners_, const Tensor& faces_, int64_t rows, int64_t cols) {
  const Tensor corners = torch::stable::contiguous(corners_), faces = torch::stable::contiguous(faces_);
  const MeshProblem p = mesh_problem(corners, faces, rows, cols);
  Tensor result = torch::stable::new_zeros(corners, {p.images, rows, cols});
  double* images = result.mutable_data_ptr<double>();
  torch::stable::parallel_for(0, p.images * p.bands(), 1, [&](int64_t begin, int64_t end) {
    for (int64_t t = begin; t < end; ++t) {
      const int64_t image = t / p.bands(), row = t % p.bands() * kRowsOfTask;
      add_band(p, image, row, std::min(row + kRowsOfTask, rows), images + image * rows * cols);
    }
  });
  return result;
}

Tensor mesh_lengths_backward(const Tensor& gradient_, const Tensor& corners_, const Tensor& faces_) {
  const Tensor gradient = torch::stable::contiguous(gradient_);
  const Tensor corners = torch::stable::contiguous(corners_), faces = torch::stable::contiguous(faces_);
  STD_TORCH_CHECK(gradient.dim() == 3 && gradient.size(0) == corners.size(0),
                  "gradient must have shape (B, rows, cols)");
  STD_TORCH_CHECK(gradient.is_cpu() && gradient.scalar_type() == ScalarType::Double,
                  "gradient must be float64 on the CPU");
  const MeshProblem p = mesh_problem(corners, faces, gradient.size(1), gradient.size(2));
  Tensor result = torch::stable::new_zeros(corners, {p.images, p.vertices, 3});
  double* sums = result.mutable_data_ptr<double>();
  const int64_t size = p.vertices * 3;
  std::vector<double> bands(p.bands() * size);  // one image at a time: all views at once could take gigabytes
  for (int64_t image = 0; image < p.images; ++image) {
    std::fill(bands.begin(), bands.end(), 0.0);
    torch::stable::parallel_for(0, p.bands(), 1, [&](int64_t begin, int64_t end) {
      for (int64_t t = begin; t < end; ++t) {
        const int64_t row = t * kRowsOfTask;
        add_band_gradient(p, image, row, std::min(row + kRowsOfTask, p.rows),
                          gradient.const_data_ptr<double>() + image * p.rows * p.cols, bands.data() + t * size);
      }
    });
    for (int64_t t = 0; t < p.bands(); ++t) {
      for (int64_t i = 0; i < size; ++i) sums[image * size + i] += bands[t * size + i];
    }
  }
  return result;
}

}  // namespace
}  // namespace torchkcreg

STABLE_TORCH_LIBRARY_IMPL(torchkcreg, CPU, m) {
  m.impl("mesh_lengths", TORCH_BOX(&torchkcreg::mesh_lengths));
  m.impl("mesh_lengths_backward", TORCH_BOX(&torchkcreg::mesh_lengths_backward));
}
