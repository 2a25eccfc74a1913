// A copy of a volume in the memory order of the voxel kernels: z innermost, with a frame of zeros around it, so that
// interpolation at the border needs no bounds check and back-projection beyond it stays in the buffer.

#pragma once

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <cstdint>
#include <vector>

namespace torchkcreg {
namespace {

template <typename scalar_t>
class Lattice {
 public:
  static constexpr int64_t kLine = 64 / sizeof(scalar_t);

  // Counts of voxels along x, y, z.
  explicit Lattice(const int64_t* counts) : counts_{counts[0], counts[1], counts[2]} {
    // An odd number of cache lines, so that neighbouring columns don't compete for the same cache sets.
    pitch_ = ((counts[2] + 2 + kLine - 1) / kLine | 1) * kLine;
    values_.assign((counts[0] + 2) * (counts[1] + 2) * pitch_ + kLine, scalar_t(0));
  }

  int64_t count(int axis) const { return counts_[axis]; }
  int64_t stride(int axis) const { return axis == 0 ? pitch_ : axis == 1 ? (counts_[0] + 2) * pitch_ : 1; }
  // Voxel (x, y, z), indices from -1 (the frame) to count.
  scalar_t* at(int64_t x, int64_t y, int64_t z) {
    return values_.data() + ((y + 1) * (counts_[0] + 2) + x + 1) * pitch_ + z + 1;
  }
  const scalar_t* at(int64_t x, int64_t y, int64_t z) const { return const_cast<Lattice*>(this)->at(x, y, z); }

  void zero() { std::fill(values_.begin(), values_.end(), scalar_t(0)); }

  // Volumes are (z, y, x), contiguous.
  void copy_from(const scalar_t* volume) {
    each_tile([&](int64_t x, int64_t y, int64_t z) { *at(x, y, z) = volume[index(x, y, z)]; });
  }
  void copy_to(scalar_t* volume) const {
    each_tile([&](int64_t x, int64_t y, int64_t z) { volume[index(x, y, z)] = *at(x, y, z); });
  }

 private:
  int64_t index(int64_t x, int64_t y, int64_t z) const { return (z * counts_[1] + y) * counts_[0] + x; }

  template <typename Visit>
  void each_tile(const Visit& visit) const {
    constexpr int64_t kTile = 16;
    torch::stable::parallel_for(0, counts_[1], 1, [&](int64_t begin, int64_t end) {
      for (int64_t y = begin; y < end; ++y) {
        for (int64_t z0 = 0; z0 < counts_[2]; z0 += kTile) {
          for (int64_t x0 = 0; x0 < counts_[0]; x0 += kTile) {
            for (int64_t x = x0; x < std::min(x0 + kTile, counts_[0]); ++x) {
              for (int64_t z = z0; z < std::min(z0 + kTile, counts_[2]); ++z) visit(x, y, z);
            }
          }
        }
      }
    });
  }

  int64_t counts_[3];
  int64_t pitch_;
  std::vector<scalar_t> values_;
};

}  // namespace
}  // namespace torchkcreg
