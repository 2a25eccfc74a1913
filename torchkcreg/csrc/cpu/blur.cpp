// CPU kernel of a separable filter along rows and columns with replicated border, and of its transpose. Each task
// writes a few rows of one image, and no other task writes them, so sums don't depend on the number of threads.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <algorithm>
#include <vector>

#include "lines.h"

namespace torchkcreg {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

constexpr int64_t kRowsOfTask = 16;

// Border handling for a line of n pixels. Forward, a pixel beyond the border has the value of the last one inside;
// transposed, contributions to such a pixel are added to the last one inside.
template <typename scalar_t>
class Filter {
 public:
  Filter(const scalar_t* kernel, int64_t taps, bool transposed)
      : taps_(taps), radius_(taps / 2), transposed_(transposed), kernel_(kernel, kernel + taps), flipped_(kernel_) {
    std::reverse(flipped_.begin(), flipped_.end());
  }

  int64_t radius() const { return radius_; }

  // Input lines of output line i of n: first, first + 1, ...; returns their number.
  int64_t share(int64_t i, int64_t n, int64_t& first, std::vector<scalar_t>& weights) const {
    first = std::max<int64_t>(i - radius_, 0);
    const int64_t last = std::min(i + radius_, n - 1);
    weights.assign(last - first + 1, scalar_t(0));
    if (!transposed_) {
      for (int64_t t = 0; t < taps_; ++t) {
        weights[std::min(std::max<int64_t>(i + t - radius_, 0), n - 1) - first] += kernel_[t];
      }
      return last - first + 1;
    }
    for (int64_t from = first; from <= last; ++from) {
      const int64_t tap = i - from + radius_;
      const int64_t begin = i == 0 ? 0 : tap, end = i == n - 1 ? taps_ - 1 : tap;
      for (int64_t t = begin; t <= end; ++t) weights[from - first] += kernel_[t];
    }
    return last - first + 1;
  }

  // Filters one line of n pixels. It has room for `radius` more on each side, which are filled here.
  template <int L>
  TORCHKCREG_INLINE void along(scalar_t* padded, int64_t n, scalar_t* out) const {
    scalar_t* line = padded + radius_;
    std::fill(padded, line, transposed_ ? scalar_t(0) : line[0]);
    std::fill(line + n, line + n + radius_, transposed_ ? scalar_t(0) : line[n - 1]);
    const scalar_t* taps = transposed_ ? flipped_.data() : kernel_.data();
    weigh_lines<scalar_t, L>(taps_, taps, [&](int64_t t) { return padded + t; }, n, out);
    if (!transposed_) return;
    // Contributions that taps would have written beyond an end, mostly from the pixels next to it.
    scalar_t before = 0, behind = 0;
    for (int64_t j = 0; j < std::min(radius_, n); ++j) {
      for (int64_t t = 0; t < radius_ - j; ++t) before += kernel_[t] * line[j];
      for (int64_t t = radius_ + j + 1; t < taps_; ++t) behind += kernel_[t] * line[n - 1 - j];
    }
    out[0] += before;
    out[n - 1] += behind;
  }

 private:
  int64_t taps_, radius_;
  bool transposed_;
  std::vector<scalar_t> kernel_, flipped_;
};

template <typename scalar_t>
struct BlurTask {
  const scalar_t* from;
  scalar_t* to;
  int64_t rows, cols, begin, end;  // of the image; the range of rows to compute
};

template <typename scalar_t, int L>
TORCHKCREG_INLINE void blur_rows_kernel(const Filter<scalar_t>& filter, const BlurTask<scalar_t>& task) {
  std::vector<scalar_t> weights, line(task.cols + 2 * filter.radius() + kMaxReadAhead);
  for (int64_t row = task.begin; row < task.end; ++row) {
    int64_t first = 0;
    const int64_t count = filter.share(row, task.rows, first, weights);
    const scalar_t* top = task.from + first * task.cols;
    weigh_lines<scalar_t, L>(
        count, weights.data(), [&](int64_t k) { return top + k * task.cols; }, task.cols,
        line.data() + filter.radius());
    filter.template along<L>(line.data(), task.cols, task.to + row * task.cols);
  }
}

TORCHKCREG_BY_PROCESSOR(float, blur_rows, (const Filter<float>& filter, const BlurTask<float>& task), (filter, task))
TORCHKCREG_BY_PROCESSOR(double, blur_rows, (const Filter<double>& filter, const BlurTask<double>& task), (filter, task))

template <typename scalar_t>
void blur_images(const Tensor& images, const Tensor& kernel, bool transposed, Tensor& result) {
  const int64_t rows = images.size(1), cols = images.size(2), bands = (rows + kRowsOfTask - 1) / kRowsOfTask;
  const Filter<scalar_t> filter(kernel.const_data_ptr<scalar_t>(), kernel.size(0), transposed);
  const scalar_t* from = images.const_data_ptr<scalar_t>();
  scalar_t* to = result.mutable_data_ptr<scalar_t>();
  torch::stable::parallel_for(0, images.size(0) * bands, 1, [&](int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; ++k) {
      const int64_t offset = k / bands * rows * cols, row = k % bands * kRowsOfTask;
      blur_rows(filter,
                BlurTask<scalar_t>{from + offset, to + offset, rows, cols, row, std::min(row + kRowsOfTask, rows)});
    }
  });
}

Tensor blur(const Tensor& images_, const Tensor& kernel_, bool transposed) {
  STD_TORCH_CHECK(images_.dim() == 3, "images must have shape (B, rows, cols)");
  STD_TORCH_CHECK(kernel_.dim() == 1 && kernel_.size(0) % 2 == 1, "kernel must have an odd number of taps");
  const ScalarType dtype = images_.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double, "images must be float32 or float64");
  STD_TORCH_CHECK(images_.is_cpu() && kernel_.is_cpu() && kernel_.scalar_type() == dtype,
                  "tensors must be on the CPU and of one dtype");
  const Tensor images = torch::stable::contiguous(images_), kernel = torch::stable::contiguous(kernel_);
  Tensor result = torch::stable::new_empty(images, {images.size(0), images.size(1), images.size(2)});
  if (images.numel() == 0) return result;
  if (dtype == ScalarType::Float) {
    blur_images<float>(images, kernel, transposed, result);
  } else {
    blur_images<double>(images, kernel, transposed, result);
  }
  return result;
}

}  // namespace
}  // namespace torchkcreg

STABLE_TORCH_LIBRARY_IMPL(torchkcreg, CPU, m) { m.impl("blur", TORCH_BOX(&torchkcreg::blur)); }
