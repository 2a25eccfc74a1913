// CPU kernel of the transmitted signal behind several materials: exponentials over energies, the system's blur and the
// averaging over a pixel's sub-pixels in one pass. Each task computes the image of one candidate and view, and no
// other task writes to it, so sums don't depend on the number of threads.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <tuple>
#include <vector>

#include "transmission_image.h"

namespace torchkcreg {
namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

TransmissionShape check(const Tensor& lengths, const Tensor& attenuation, const Tensor& weights, const Tensor& kernel,
                        int64_t pooling) {
  STD_TORCH_CHECK(lengths.dim() == 5, "lengths must have shape (K, M, V, rows, cols)");
  STD_TORCH_CHECK(attenuation.dim() == 2 && attenuation.size(0) == lengths.size(1), "attenuation must be (M, E)");
  STD_TORCH_CHECK(weights.dim() == 3 && weights.size(0) == lengths.size(0) && weights.size(1) == lengths.size(2) &&
                      weights.size(2) == attenuation.size(1),
                  "weights must have shape (K, V, E)");
  STD_TORCH_CHECK(kernel.dim() == 2 && kernel.size(0) == lengths.size(0) && kernel.size(1) % 2 == 1,
                  "kernel must have shape (K, odd)");
  STD_TORCH_CHECK(pooling > 0 && lengths.size(3) % pooling == 0 && lengths.size(4) % pooling == 0,
                  "pooling must divide rows and cols");
  const ScalarType dtype = lengths.scalar_type();
  STD_TORCH_CHECK(dtype == ScalarType::Float || dtype == ScalarType::Double, "lengths must be float32 or float64");
  for (const Tensor* t : {&lengths, &attenuation, &weights, &kernel}) {
    STD_TORCH_CHECK(t->is_cpu() && t->scalar_type() == dtype, "tensors must be on the CPU and of one dtype");
  }
  return TransmissionShape{lengths.size(0), lengths.size(1),     lengths.size(2), lengths.size(3),
                           lengths.size(4), attenuation.size(1), kernel.size(1),  pooling};
}

template <typename scalar_t>
struct TransmissionInputs {
  const scalar_t *lengths, *attenuation, *weights, *kernel;

  TransmissionInputs(const Tensor& l, const Tensor& a, const Tensor& w, const Tensor& k)
      : lengths(l.const_data_ptr<scalar_t>()),
        attenuation(a.const_data_ptr<scalar_t>()),
        weights(w.const_data_ptr<scalar_t>()),
        kernel(k.const_data_ptr<scalar_t>()) {}

  // Inputs and outputs of the task of candidate k and view v.
  TransmissionImage<scalar_t> image(const TransmissionShape& p, int64_t k, int64_t v) const {
    const int64_t pixels = p.rows * p.cols;
    return {lengths + (k * p.materials * p.views + v) * pixels, p.views * pixels, attenuation,
            weights + (k * p.views + v) * p.energies, kernel + k * p.taps};
  }
};

template <typename scalar_t>
void transmit(const TransmissionShape& p, const TransmissionInputs<scalar_t>& in, scalar_t* result) {
  const int64_t pooled = p.rows / p.pooling * (p.cols / p.pooling);
  torch::stable::parallel_for(0, p.candidates * p.views, 1, [&](int64_t begin, int64_t end) {
    TransmissionScratch<scalar_t> scratch(p);
    for (int64_t task = begin; task < end; ++task) {
      transmit_image(p, in.image(p, task / p.views, task % p.views), scratch, result + task * pooled);
    }
  });
}

template <typename scalar_t>
struct TransmissionGradients {
  scalar_t *lengths, *attenuation, *weights, *kernel;
};

template <typename scalar_t>
void transmit_backward(const TransmissionShape& p, const TransmissionInputs<scalar_t>& in, const scalar_t* grad,
                       const TransmissionGradients<scalar_t>& out) {
  const int64_t tasks = p.candidates * p.views, pixels = p.rows * p.cols, table = p.materials * p.energies;
  const int64_t pooled = p.rows / p.pooling * (p.cols / p.pooling);
  std::vector<double> to_attenuation(out.attenuation ? tasks * table : 0), to_kernel(tasks * p.taps);
  torch::stable::parallel_for(0, tasks, 1, [&](int64_t begin, int64_t end) {
    TransmissionScratch<scalar_t> scratch(p);
    for (int64_t task = begin; task < end; ++task) {
      const int64_t k = task / p.views, v = task % p.views;
      const ImageGradients<scalar_t> to{out.lengths + (k * p.materials * p.views + v) * pixels, p.views * pixels,
                                        out.attenuation ? to_attenuation.data() + task * table : nullptr,
                                        out.weights + task * p.energies, to_kernel.data() + task * p.taps};
      transmit_image_backward(p, in.image(p, k, v), grad + task * pooled, scratch, to);
    }
  });
  for (int64_t i = 0; out.attenuation && i < table; ++i) {
    double sum = 0;
    for (int64_t task = 0; task < tasks; ++task) sum += to_attenuation[task * table + i];
    out.attenuation[i] = scalar_t(sum);
  }
  for (int64_t k = 0; k < p.candidates; ++k) {
    for (int64_t t = 0; t < p.taps; ++t) {
      double sum = 0;
      for (int64_t v = 0; v < p.views; ++v) sum += to_kernel[(k * p.views + v) * p.taps + t];
      out.kernel[k * p.taps + t] = scalar_t(sum);
    }
  }
}

Tensor transmission(const Tensor& lengths_, const Tensor& attenuation_, const Tensor& weights_, const Tensor& kernel_,
                    int64_t pooling) {
  const TransmissionShape p = check(lengths_, attenuation_, weights_, kernel_, pooling);
  const Tensor lengths = torch::stable::contiguous(lengths_), attenuation = torch::stable::contiguous(attenuation_);
  const Tensor weights = torch::stable::contiguous(weights_), kernel = torch::stable::contiguous(kernel_);
  Tensor result = torch::stable::new_empty(lengths, {p.candidates, p.views, p.rows / pooling, p.cols / pooling});
  if (lengths.scalar_type() == ScalarType::Float) {
    transmit(p, TransmissionInputs<float>(lengths, attenuation, weights, kernel), result.mutable_data_ptr<float>());
  } else {
    transmit(p, TransmissionInputs<double>(lengths, attenuation, weights, kernel), result.mutable_data_ptr<double>());
  }
  return result;
}

template <typename scalar_t>
TransmissionGradients<scalar_t> gradient_pointers(const Tensor& l, const Tensor& a, const Tensor& w, const Tensor& k) {
  return {l.mutable_data_ptr<scalar_t>(), a.numel() ? a.mutable_data_ptr<scalar_t>() : nullptr,
          w.mutable_data_ptr<scalar_t>(), k.mutable_data_ptr<scalar_t>()};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> transmission_backward(const Tensor& grad_, const Tensor& lengths_,
                                                                 const Tensor& attenuation_, const Tensor& weights_,
                                                                 const Tensor& kernel_, int64_t pooling,
                                                                 bool need_attenuation) {
  const TransmissionShape p = check(lengths_, attenuation_, weights_, kernel_, pooling);
  STD_TORCH_CHECK(grad_.dim() == 4 && grad_.size(0) == p.candidates && grad_.size(1) == p.views &&
                      grad_.size(2) == p.rows / pooling && grad_.size(3) == p.cols / pooling && grad_.is_cpu() &&
                      grad_.scalar_type() == lengths_.scalar_type(),
                  "grad must fit the images");
  const Tensor lengths = torch::stable::contiguous(lengths_), attenuation = torch::stable::contiguous(attenuation_);
  const Tensor weights = torch::stable::contiguous(weights_), kernel = torch::stable::contiguous(kernel_);
  const Tensor grad = torch::stable::contiguous(grad_);
  Tensor to_lengths = torch::stable::new_empty(lengths, {p.candidates, p.materials, p.views, p.rows, p.cols});
  Tensor to_attenuation = need_attenuation ? torch::stable::new_empty(lengths, {p.materials, p.energies})
                                           : torch::stable::new_empty(lengths, {0});
  Tensor to_weights = torch::stable::new_empty(lengths, {p.candidates, p.views, p.energies});
  Tensor to_kernel = torch::stable::new_empty(lengths, {p.candidates, p.taps});
  if (lengths.scalar_type() == ScalarType::Float) {
    transmit_backward(p, TransmissionInputs<float>(lengths, attenuation, weights, kernel), grad.const_data_ptr<float>(),
                      gradient_pointers<float>(to_lengths, to_attenuation, to_weights, to_kernel));
  } else {
    transmit_backward(p, TransmissionInputs<double>(lengths, attenuation, weights, kernel),
                      grad.const_data_ptr<double>(),
                      gradient_pointers<double>(to_lengths, to_attenuation, to_weights, to_kernel));
  }
  return {to_lengths, to_attenuation, to_weights, to_kernel};
}

}  // namespace
}  // namespace torchkcreg

STABLE_TORCH_LIBRARY_IMPL(torchkcreg, CPU, m) {
  m.impl("transmission", TORCH_BOX(&torchkcreg::transmission));
  m.impl("transmission_backward", TORCH_BOX(&torchkcreg::transmission_backward));
}
