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

// The first `used` numbers of rows of `width`.
inline void load_numbers(const float* rows, size_t width, const uint32_t* ids, size_t used,
                         Lanes* to) {
  if (used < 4) {  // degree 0, and perhaps rows of 3
    for (size_t k = 0; k < used; k++)
      for (int i = 0; i < kLanes; i++) to[k][i] = rows[ids[i] * width + k];
    return;
  }
  for (size_t k = 0; k < used; k += 4) {
    const size_t from = std::min(k, used - 4);
    load_columns([&](int i) { return rows + ids[i] * width + from; }, to + from);
  }
}

// The opposite.
inline void store_numbers(const Lanes* from, size_t used, const Picked& who, float* rows,
                          size_t width) {
  float scratch[48];  // where lanes go that are not meant
  const auto row = [&](int lane) {
    return lane < who.count ? rows + who.ids[lane] * width : scratch;
  };
  if (used < 4) {
    for (int lane = 0; lane < who.count; lane++)
      for (size_t k = 0; k < used; k++) row(lane)[k] = from[k][lane];
    return;
  }
  for (size_t k = 0; k < used; k += 4) {
    const size_t first = std::min(k, used - 4);
    store_rows(from + first, [&](int lane) { return row(lane) + first; });
  }
}

// Zeros behind the first `used` numbers of each row.
inline void clear_rest(const Picked& who, float* rows, size_t used, size_t width) {
  for (int lane = 0; used < width && lane < who.count; lane++)
    std::fill(rows + who.ids[lane] * width + used, rows + (who.ids[lane] + size_t{1}) * width, 0.f);
}

// The numbers of each row of coefficients that lie in one array: `width` of them, from `first` on.
template <class Float>
struct Part {
  Float* rows;
  size_t first, width;

  // How many of a row's first `used` numbers are here.
  size_t held(size_t used) const { return used > first ? std::min(used - first, width) : 0; }
};

// Rows of K coefficients: in one array, or the first of each in one and the others in another.
template <class Float>
struct ShRows {
  Part<Float> part[2];

  ShRows(const fragprune_inputs& in, Float* sh, Float* rest) {
    const size_t width = 3 * static_cast<size_t>(in.sh_coefficients);
    const size_t head = in.sh_rest ? 3 : width;
    part[0] = {sh, 0, head}, part[1] = {rest, head, width - head};
  }
  Float* at(size_t i, int k) const {
    const size_t place = 3 * static_cast<size_t>(k);
    const Part<Float>& p = part[place >= part[1].first];
    return p.rows ? p.rows + i * p.width + place - p.first : nullptr;
  }
};

inline ShRows<const float> coefficient_rows(const fragprune_inputs& in) {
  return {in, in.sh, in.sh_rest};
}

inline ShRows<float> coefficient_rows(const fragprune_inputs& in, const fragprune_input_grads& to) {
  return {in, to.sh, to.sh_rest};
}

// The first `terms` coefficients of each row.
inline void load_coefficients(const ShRows<const float>& rows, const uint32_t* ids, int terms,
                              Coefficients& to) {
  const size_t used = 3 * static_cast<size_t>(terms);
  for (const Part<const float>& p : rows.part)
    load_numbers(p.rows, p.width, ids, p.held(used), to.column + p.first);
}

// The opposite, to the arrays that are there, and zeros behind them.
inline void store_coefficients(const Coefficients& from, int terms, const Picked& who,
                               const ShRows<float>& rows) {
  const size_t used = 3 * static_cast<size_t>(terms);
  for (const Part<float>& p : rows.part) {
    if (!p.rows) continue;
    store_numbers(from.column + p.first, p.held(used), who, p.rows, p.width);
    clear_rest(who, p.rows, p.held(used), p.width);
  }
}

}  // namespace fp
