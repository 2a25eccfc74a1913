// Schemas of the operators. Kernels register themselves in their own files; fake kernels and autograd are in Python
// (projector/ops.py, projector/voxel_ops.py).

#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(torchkcreg, m) {
  // points (B, N, 3), volumes (N,), matrices (V, 3, 4), table (V, num_blocks, R + 1, R + 1, T, T) -> (B, V, rows, cols)
  m.def(
      "point_drr(Tensor points, Tensor volumes, Tensor matrices, Tensor table, int block_size, int rows, int cols) "
      "-> Tensor");
  // Gradients to points, volumes and matrices; one that is not needed comes back empty.
  m.def(
      "point_drr_backward(Tensor grad, Tensor points, Tensor volumes, Tensor matrices, Tensor table, int block_size, "
      "bool need_volumes, bool need_matrices) -> (Tensor, Tensor, Tensor)");
  // volume (B, D, H, W), rays (V, 3, 4) and spacing (3,) in float64 -> (B, V, rows, cols)
  m.def("voxel_project(Tensor volume, Tensor rays, Tensor spacing, int rows, int cols) -> Tensor");
  // Its adjoint: images (B, V, rows, cols) -> (B, depth, height, width)
  m.def("voxel_backproject(Tensor images, Tensor rays, Tensor spacing, int depth, int height, int width) -> Tensor");
  // images (B, V, rows, cols), matrices (V, 3, 4) in float64 -> (B, depth, height, width)
  m.def("voxel_backproject_weighted(Tensor images, Tensor matrices, int depth, int height, int width) -> Tensor");
}
