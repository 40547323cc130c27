// Rows of the inputs and of their gradients, kLanes picked ones at a time, as columns and back.
#pragma once

#include <algorithm>

#include "gaussian.h"

namespace fp {

// Rows of 3 numbers picked by id, for registers that read a fourth: the array's last row is copied.
class Triples {
 public:
  Triples(const float* data, int64_t count) : data_(data), last_(static_cast<uint32_t>(count - 1)) {
    if (data && count > 0) std::copy(data + 3 * size_t{last_}, data + 3 * size_t{last_} + 3, copy_);
  }
  Vec<Lanes> load(const uint32_t* ids) const {
    Lanes v[4];
    const auto row = [&](int i) { return ids[i] == last_ ? copy_ : data_ + size_t{3} * ids[i]; };
    load_columns(row, v);
    return {v[0], v[1], v[2]};
  }

 private:
  const float* data_;
  uint32_t last_;
  float copy_[4] = {};
};

// kLanes Gaussians by their rows. `count` are meant; the others repeat the last.
struct Picked {
  uint32_t ids[kLanes];
  int count;

  template <int kWidth>
  void write(float* to, const Lanes* column) const {
    if (!to) return;
    float values[kWidth][kLanes];
    for (int k = 0; k < kWidth; k++) store(values[k], column[k]);
    for (int lane = 0; lane < count; lane++)
      for (int k = 0; k < kWidth; k++)
        to[static_cast<size_t>(ids[lane]) * kWidth + k] = values[k][lane];
  }
  void write(float* to, const Vec<Lanes>& v) const { write<3>(to, &v.x); }
  void write(float* to, const Lanes* column, int width) const {
    for (int k = 0; to && k < width; k++)
      for (int lane = 0; lane < count; lane++)
        to[static_cast<size_t>(ids[lane]) * width + k] = column[k][lane];
  }
};

// The spherical harmonics' coefficients of kLanes Gaussians as columns, 3 k + channel.
struct Coefficients {
  Lanes column[48];
  Vec<Lanes> operator()(int k) const {
    return {column[3 * k], column[3 * k + 1], column[3 * k + 2]};
  }
  void set(int k, const Vec<Lanes>& v) {
    column[3 * k] = v.x, column[3 * k + 1] = v.y, column[3 * k + 2] = v.z;
  }
};

// The first of them in rows of `width` numbers.
inline void load_coefficients(const float* rows, size_t width, const uint32_t* ids, int terms,
                              Coefficients& to) {
  const int used = 3 * terms;
  if (used < 4) {  // degree 0, and perhaps rows of 3
    for (int k = 0; k < used; k++)
      for (int i = 0; i < kLanes; i++) to.column[k][i] = rows[ids[i] * width + k];
    return;
  }
  for (int k = 0; k < used; k += 4) {
    const int from = std::min(k, used - 4);
    load_columns([&](int i) { return rows + ids[i] * width + from; }, to.column + from);
  }
}

// The opposite.
inline void store_coefficients(const Coefficients& from, int terms, const Picked& who, float* rows,
                               size_t width) {
  const size_t used = 3 * static_cast<size_t>(terms);
  float scratch[48];  // where lanes go that are not meant
  const auto row = [&](int lane) {
    return lane < who.count ? rows + who.ids[lane] * width : scratch;
  };
  if (used < 4) {
    for (int lane = 0; lane < who.count; lane++)
      for (size_t k = 0; k < used; k++) row(lane)[k] = from.column[k][lane];
    return;
  }
  for (size_t k = 0; k < used; k += 4) {
    const size_t first = std::min(k, used - 4);
    store_rows(from.column + first, [&](int lane) { return row(lane) + first; });
  }
}

// Zeros behind the first `used` numbers of each row.
inline void clear_rest(const Picked& who, float* rows, size_t used, size_t width) {
  for (int lane = 0; used < width && lane < who.count; lane++)
    std::fill(rows + who.ids[lane] * width + used, rows + (who.ids[lane] + size_t{1}) * width, 0.f);
}

}  // namespace fp
