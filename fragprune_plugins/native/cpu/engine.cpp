// The C interface on a CPU: project, sort, bin, blend; and back.

#include <array>
#include <cstdio>
#include <new>
#include <stdexcept>
#include <utility>

#include "blend.h"

struct fragprune_state {
  fragprune_inputs in;
  fp::Camera camera;
  fp::Buffer<fp::Splat> splats;
  fp::Buffer<uint32_t> slot_begin;   // per splat, one more at the end
  fp::TileLists lists;
  fp::Buffer<size_t> words;          // per tile: where its bits begin
  fp::Buffer<uint64_t> reached;      // see find_blocks
  fp::Buffer<fp::TilePixels> pixels;  // per tile
};

namespace fp {
namespace {

constexpr size_t kGrain = 1024;  // Gaussians per piece of work

// ---- projection ------------------------------------------------------------------------------

// The whole way of one Gaussian to what blending needs; false: it cannot draw anything. Colour is
// computed last, for those that are left.
bool make_splat(const Camera& c, const fragprune_inputs& in, int64_t i, int32_t* radius, Splat& s,
                float* depth, std::vector<Run>& runs) {
  Projection p;
  *radius = 0;
  if (!project(c, in, i, p)) return false;
  *radius = p.radius;
  const float opacity = in.opacities[i] * compensation(c, p);
  const float threshold = in.thresholds ? in.thresholds[i] : 0.f;
  if (!(opacity > 0 && opacity < 1e30f && threshold >= 0)) return false;
  Brush& b = s.brush;
  b.log_opacity = std::log2(opacity);
  b.cut = cut_of(b.log_opacity, threshold);
  b.list_cut = in.widen ? cut_of(b.log_opacity, rim_reach(threshold)) : b.cut;
  if (!(b.list_cut <= b.log_opacity)) return false;
  b.x = p.x;
  b.y = p.y;
  b.scale = std::sqrt(0.5f * kLog2E * (p.var_y / p.det));
  b.skew = -b.scale * (p.cov / p.var_y);
  b.down = std::sqrt(0.5f * kLog2E / p.var_y);
  b.inv_z = 1 / p.view.z;
  const size_t before = runs.size();
  reached_tiles(c, p, b, [&](Run run) { runs.push_back(run); });
  if (runs.size() == before) return false;
  const Vec3 colour = colour_of(c, in, i);
  if (!(std::fabs(colour.x) + std::fabs(colour.y) + std::fabs(colour.z) < 1e30f)) {
    runs.resize(before);
    return false;
  }
  b.r = colour.x, b.g = colour.y, b.b = colour.z;
  s.id = static_cast<uint32_t>(i);
  *depth = p.view.z;
  return true;
}

Scene project_all(Team& team, const Camera& c, const fragprune_inputs& in, int32_t* radii) {
  struct Piece {
    std::vector<Splat> splats;
    std::vector<float> depth;
    std::vector<uint32_t> run_end, slot_end;
    std::vector<Run> runs;
  };
  const size_t n = static_cast<size_t>(in.count), pieces = (n + kGrain - 1) / kGrain;
  std::vector<Piece> found(pieces);
  team.each(n, kGrain, [&](size_t begin, size_t end) {
    Piece& mine = found[begin / kGrain];
    mine.splats.reserve(end - begin);
    mine.runs.reserve(4 * (end - begin));
    Splat splat;
    float depth;
    uint64_t slots = 0;
    for (size_t i = begin; i < end; i++) {
      const size_t runs = mine.runs.size();
      if (!make_splat(c, in, static_cast<int64_t>(i), radii + i, splat, &depth, mine.runs)) continue;
      for (size_t r = runs; r < mine.runs.size(); r++)
        slots += mine.runs[r].x1 - mine.runs[r].x0 + 1;
      if (slots > UINT32_MAX) throw std::length_error("tile lists");
      mine.splats.push_back(splat);
      mine.depth.push_back(depth);
      mine.run_end.push_back(static_cast<uint32_t>(mine.runs.size()));
      mine.slot_end.push_back(static_cast<uint32_t>(slots));
    }
  });
  struct Place {
    size_t splat, run, slot;
  };
  std::vector<Place> place(pieces + 1, Place{0, 0, 0});
  for (size_t k = 0; k < pieces; k++) {
    const Piece& p = found[k];
    place[k + 1] = {place[k].splat + p.splats.size(), place[k].run + p.runs.size(),
                    place[k].slot + (p.slot_end.empty() ? 0 : p.slot_end.back())};
  }
  const Place total = place[pieces];  // runs are fewer than slots
  if (total.slot > UINT32_MAX) throw std::length_error("tile lists");
  Scene scene{Buffer<Splat>(total.splat), Buffer<float>(total.splat),
              Buffer<uint32_t>(total.splat + 1), Buffer<uint32_t>(total.splat + 1),
              Buffer<Run>(total.run)};
  scene.run_begin[0] = scene.slot_begin[0] = 0;
  team.each(pieces, 1, [&](size_t k, size_t) {
    Piece mine;
    std::swap(mine, found[k]);  // freed as soon as it is copied
    const Place at = place[k];
    std::copy(mine.splats.begin(), mine.splats.end(), scene.splats.data() + at.splat);
    std::copy(mine.depth.begin(), mine.depth.end(), scene.depth.data() + at.splat);
    std::copy(mine.runs.begin(), mine.runs.end(), scene.runs.data() + at.run);
    for (size_t j = 0; j < mine.run_end.size(); j++) {
      scene.run_begin[at.splat + j + 1] = static_cast<uint32_t>(at.run) + mine.run_end[j];
      scene.slot_begin[at.splat + j + 1] = static_cast<uint32_t>(at.slot) + mine.slot_end[j];
    }
  });
  return scene;
}

// ---- forward ---------------------------------------------------------------------------------

Tile tile_at(const Camera& c, const TileLists& lists, size_t t) {
  const uint32_t first = lists.first[t];
  return {static_cast<int>(t % c.tiles_x) * kTile, static_cast<int>(t / c.tiles_x) * kTile,
          lists.splat.data() + first, static_cast<int>(lists.first[t + 1] - first)};
}

void draw(Team& team, const Camera& c, const fragprune_inputs& in, const Buffer<Splat>& splats,
          const TileLists& lists, fragprune_outputs& out, fragprune_state* keep) {
  const Canvas canvas{in.width,  in.height,    {in.background[0], in.background[1], in.background[2]},
                      out.image, out.invdepth, out.alpha, out.fragments};
  const size_t tiles = lists.first.size() - 1;
  std::atomic<int64_t> drawn{0}, evaluated{0};
  team.each(tiles, 1, [&](size_t t, size_t) {
    const Tile tile = tile_at(c, lists, t);
    TilePixels* pixels = keep ? &keep->pixels[t] : nullptr;
    uint64_t* reached = keep ? keep->reached.data() + keep->words[t] : nullptr;
    TileCounts counts;
    if (out.fragments_per_gaussian) {
      std::vector<int32_t> each(tile.length, 0);
      counts = blend_tile<true>(splats.data(), tile, canvas, pixels, reached, each.data());
      for (int j = 0; j < tile.length; j++)
        if (each[j])
          __atomic_fetch_add(out.fragments_per_gaussian + splats[tile.list[j]].id, each[j],
                             __ATOMIC_RELAXED);
    } else {
      counts = blend_tile<false>(splats.data(), tile, canvas, pixels, reached, nullptr);
    }
    drawn.fetch_add(counts.drawn, std::memory_order_relaxed);
    evaluated.fetch_add(counts.evaluated, std::memory_order_relaxed);
  });
  out.drawn = drawn;
  out.evaluated = evaluated;
}

void forward(const fragprune_inputs& in, fragprune_outputs& out, fragprune_state* keep) {
  Team team(in.threads);
  const Camera camera = unpack_camera(in);
  Scene scene = project_all(team, camera, in, out.radii);
  const Buffer<uint32_t> order = order_by_depth(team, scene.depth, scene.depth.size());
  TileLists lists = distribute(team, camera, scene, order, keep != nullptr);
  if (out.fragments_per_gaussian)
    std::fill_n(out.fragments_per_gaussian, static_cast<size_t>(in.count), 0);
  if (keep) {
    const size_t tiles = lists.first.size() - 1;
    keep->words = Buffer<size_t>(tiles);
    size_t words = 0;
    for (size_t t = 0; t < tiles; t++) {
      keep->words[t] = words;
      words += (lists.first[t + 1] - lists.first[t] + kWord - 1) / kWord * kBlocks;
    }
    keep->reached = Buffer<uint64_t>(words);
    keep->pixels = Buffer<TilePixels>(tiles);
  }
  draw(team, camera, in, scene.splats, lists, out, keep);
  if (keep) {
    keep->in = in;
    keep->camera = camera;
    keep->splats = std::move(scene.splats);
    keep->slot_begin = std::move(scene.slot_begin);
    keep->lists = std::move(lists);
  }
}

// ---- backward --------------------------------------------------------------------------------

struct Losses {
  const fragprune_output_grads& grads;
  float background[3];
  size_t plane;
};

// One plane of the image into block order; pixels outside the image, and a plane of NULL, are 0.
void load_plane(const Camera& c, const Tile& tile, const float* plane, float* to) {
  const int width = static_cast<int>(c.width), height = static_cast<int>(c.height);
  if (!plane || tile.x + kTile > width || tile.y + kTile > height) std::fill_n(to, kPixels, 0.f);
  if (!plane) return;
  const int wide = std::min(kTile, width - tile.x), high = std::min(kTile, height - tile.y);
  for (int y = 0; y < high; y++) {
    const float* from = plane + static_cast<size_t>(tile.y + y) * width + tile.x;
    for (int x = 0; x < wide; x += kBlockWidth) {
      const int block = y / kBlockHeight * 4 + x / kBlockWidth;
      float* at = to + block * kLanes + y % kBlockHeight * kBlockWidth;
      if (x + kBlockWidth <= wide)
        std::memcpy(at, from + x, kBlockWidth * sizeof *at);
      else
        std::copy(from + x, from + wide, at);
    }
  }
}

// Brings a tile's loss gradients into block order and starts the walk from the last fragment.
void load_losses(const Camera& c, const Losses& from, const Tile& tile, const TilePixels& kept,
                 LossPixels& to, double* by_background) {
  const float* image = from.grads.image;
  float alpha[kPixels];
  load_plane(c, tile, image, to.r);
  load_plane(c, tile, image ? image + from.plane : nullptr, to.g);
  load_plane(c, tile, image ? image + 2 * from.plane : nullptr, to.b);
  load_plane(c, tile, from.grads.invdepth, to.inv_z);
  load_plane(c, tile, from.grads.alpha, alpha);
  Lanes sums[3] = {};
  for (int i = 0; i < kPixels; i += kLanes) {
    const Lanes light = load(kept.transmittance + i);
    const Lanes r = load(to.r + i), g = load(to.g + i), b = load(to.b + i);
    const Lanes seen = r * broadcast<Lanes>(from.background[0]) +
                       g * broadcast<Lanes>(from.background[1]) +
                       b * broadcast<Lanes>(from.background[2]) - load(alpha + i);
    store(to.light + i, light);
    store(to.behind + i, light * seen);
    sums[0] = sums[0] + light * r, sums[1] = sums[1] + light * g, sums[2] = sums[2] + light * b;
  }
  for (int k = 0; k < 3; k++) by_background[k] = sum(sums[k]);
}

using UnblendTile = void (*)(const Splat*, const Tile&, const TilePixels&, const uint64_t*,
                             const uint32_t*, const RimLoss&, LossPixels&, float*);

template <size_t... kWants>
constexpr std::array<UnblendTile, sizeof...(kWants)> unblenders(std::index_sequence<kWants...>) {
  return {unblend_tile<static_cast<int>(kWants)>...};
}

PixelSums unpack_sums(const float* v, int want) {
  PixelSums s{};
  s.w = *v++;
  if (want & kThreshold) s.threshold = *v++;
  if (want & kGeometry) s.u = *v++, s.v = *v++, s.uu = *v++, s.uv = *v++, s.vv = *v++;
  if (want & kColour) s.r = *v++, s.g = *v++, s.b = *v++;
  if (want & kDepth && want & kGeometry) s.inv_z = *v++;
  return s;
}

// From the sums over pixels to the inputs of one Gaussian.
void chain(const fragprune_state& state, const fragprune_input_grads& to, int want, int64_t i,
           const PixelSums& sums) {
  const Camera& c = state.camera;
  const fragprune_inputs& in = state.in;
  if (to.thresholds) to.thresholds[i] = sums.threshold;
  if (to.opacities) to.opacities[i] = sums.w / in.opacities[i];  // alpha is proportional to it
  if (to.colors) write3(to.colors + 3 * i, {sums.r, sums.g, sums.b});
  Vec3 by_mean = {0, 0, 0};
  if (in.sh && want & kColour) {
    float* by_sh = to.sh ? to.sh + static_cast<int64_t>(3) * in.sh_coefficients * i : nullptr;
    by_mean = sh_gradient(c, in, i, sums, by_sh, to.means != nullptr && in.sh_degree > 0);
  }
  if (!(want & kGeometry)) return;
  Projection p;
  project(c, in, i, p);
  const ImageGradient g = image_gradient(c, p, sums);
  if (to.means2d) write3(to.means2d + 3 * i, {g.x * 0.5f * c.width, g.y * 0.5f * c.height, 0});
  const Shape shape = shape_of(c, in, i);
  Mat3 m;
  Vec3 view = shape_gradient(c, p, shape, g, m);
  view.z -= sums.inv_z / (p.view.z * p.view.z);
  if (to.means)
    write3(to.means + 3 * i, by_mean + mean_gradient(c, read3(in.means + 3 * i), g, view));
  if (to.cov3d) {
    float* o = to.cov3d + 6 * i;  // an off-diagonal entry stands for two
    o[0] = m.row[0].x, o[1] = m.row[0].y + m.row[1].x, o[2] = m.row[0].z + m.row[2].x;
    o[3] = m.row[1].y, o[4] = m.row[1].z + m.row[2].y, o[5] = m.row[2].z;
  }
  if (to.scales || to.rotations) {
    const Mat3 r = rotation_of(in.rotations + 4 * i);
    const Vec3 size = c.scale_modifier * read3(in.scales + 3 * i);
    if (to.scales) {
      Vec3 by_size = {0, 0, 0};
      for (int k = 0; k < 3; k++) {
        by_size.x += r.row[k].x * m.row[k].x;
        by_size.y += r.row[k].y * m.row[k].y;
        by_size.z += r.row[k].z * m.row[k].z;
      }
      write3(to.scales + 3 * i, c.scale_modifier * by_size);
    }
    if (to.rotations) {
      for (Vec3& v : m.row) v = {v.x * size.x, v.y * size.y, v.z * size.z};
      rotation_gradient(in.rotations + 4 * i, m, to.rotations + 4 * i);
    }
  }
}

// A gradient array and its numbers per Gaussian.
struct GradientRows {
  float* data;
  size_t width;
};

void backward(const fragprune_state& state, const fragprune_output_grads& grads,
              const fragprune_input_grads& to, int threads) {
  const fragprune_inputs& in = state.in;
  const TileLists& lists = state.lists;
  Team team(threads);
  int want = 0;
  if (to.means || to.means2d || to.scales || to.rotations || to.cov3d) want |= kGeometry;
  if (to.sh || to.colors || (to.means && in.sh && in.sh_degree > 0)) want |= kColour;
  if (to.thresholds) want |= kThreshold;
  if (grads.invdepth) want |= kDepth;
  const size_t n = static_cast<size_t>(in.count), sh_size = 3 * size_t(in.sh_coefficients);
  const GradientRows arrays[] = {
      {to.means, 3}, {to.means2d, 3},  {to.opacities, 1}, {to.scales, 3},    {to.rotations, 4},
      {to.cov3d, 6}, {to.sh, sh_size}, {to.colors, 3},    {to.thresholds, 1}};
  bool per_gaussian = false;
  for (const GradientRows& rows : arrays) per_gaussian |= rows.data != nullptr;
  const auto clear = [&](size_t begin, size_t end) {  // of Gaussians that draw nothing
    for (const GradientRows& rows : arrays)
      if (rows.data && begin < end)
        std::fill(rows.data + begin * rows.width, rows.data + end * rows.width, 0.f);
  };

  static constexpr auto table = unblenders(std::make_index_sequence<16>());
  const int size = sums_of(want);
  const size_t tiles = lists.first.size() - 1;
  const Losses losses{grads,
                      {in.background[0], in.background[1], in.background[2]},
                      static_cast<size_t>(in.width) * in.height};
  const float pixels = static_cast<float>(losses.plane);
  const RimLoss rim{in.thresholds, grads.fragments_per_pixel / pixels};
  Buffer<float> sums(per_gaussian ? lists.splat.size() * size : 0);
  Buffer<double> by_background(3 * tiles);
  team.each(tiles, 1, [&](size_t t, size_t) {
    const Tile tile = tile_at(state.camera, lists, t);
    LossPixels loss;
    load_losses(state.camera, losses, tile, state.pixels[t], loss, &by_background[3 * t]);
    if (per_gaussian)
      table[want](state.splats.data(), tile, state.pixels[t],
                  state.reached.data() + state.words[t], lists.slot.data() + lists.first[t], rim,
                  loss, sums.data());
  });
  if (to.background)
    for (int k = 0; k < 3; k++) {
      double total = 0;
      for (size_t t = 0; t < tiles; t++) total += by_background[3 * t + k];
      to.background[k] = static_cast<float>(total);
    }
  if (!per_gaussian) return;
  const size_t splats = state.splats.size();
  if (splats == 0) clear(0, n);
  team.each(splats, kGrain, [&](size_t begin, size_t end) {
    for (size_t k = begin; k < end; k++) {
      const size_t i = state.splats[k].id;
      clear(k ? state.splats[k - 1].id + size_t{1} : 0, i);
      float total[sums_of(15)] = {};
      const float* v = sums.data() + static_cast<size_t>(state.slot_begin[k]) * size;
      for (uint32_t slot = state.slot_begin[k]; slot < state.slot_begin[k + 1]; slot++)
        for (int s = 0; s < size; s++) total[s] += *v++;
      chain(state, to, want, static_cast<int64_t>(i), unpack_sums(total, want));
    }
    if (end == splats) clear(state.splats[splats - 1].id + size_t{1}, n);
  });
}

// ---- what the interface checks ---------------------------------------------------------------

int fail(fragprune_error* error, int status, const char* message) {
  if (error) std::snprintf(error->message, sizeof error->message, "%s", message);
  return status;
}

const char* fault_of(const fragprune_inputs* in, const fragprune_outputs* out) {
  if (!in || in->size != sizeof *in || !out || out->size != sizeof *out)
    return "structs of another version of fragprune.h";
  if (in->width < 1 || in->height < 1 || in->width > 1 << 16 || in->height > 1 << 16)
    return "width and height must be 1 to 65536 pixels";
  if (in->count < 0 || in->count > INT32_MAX) return "count must be 0 to 2^31 - 1";
  if (!in->viewmatrix || !in->projmatrix || !in->campos || !in->background)
    return "viewmatrix, projmatrix, campos and background are needed";
  if (!out->image || (in->count && !out->radii)) return "image and radii are needed";
  if (in->count == 0) return nullptr;
  if (!in->means || !in->opacities) return "means and opacities are needed";
  if (!in->scales != !in->rotations || !in->scales == !in->cov3d)
    return "either scales and rotations or cov3d is needed";
  if (!in->sh == !in->colors) return "either sh or colors is needed";
  if (in->sh && (in->sh_degree < 0 || in->sh_degree > 3 ||
                 in->sh_coefficients < (in->sh_degree + 1) * (in->sh_degree + 1)))
    return "sh_degree must be 0 to 3, with (sh_degree + 1)^2 coefficients at least";
  return nullptr;
}

template <class Work>
int guarded(fragprune_error* error, Work work) {
  if (error) error->message[0] = 0;
  try {
    work();
    return FRAGPRUNE_OK;
  } catch (const std::bad_alloc&) {
    return fail(error, FRAGPRUNE_OUT_OF_MEMORY, "out of memory");
  } catch (const std::length_error&) {
    return fail(error, FRAGPRUNE_TOO_LARGE, "more than 2^32 entries in the tile lists");
  } catch (const std::exception& e) {
    return fail(error, FRAGPRUNE_FAILED, e.what());
  }
}

}  // namespace
}  // namespace fp

extern "C" {

int fragprune_forward(const fragprune_inputs* inputs, fragprune_outputs* outputs,
                      fragprune_state** state, fragprune_error* error) {
  if (state) *state = nullptr;
  if (const char* fault = fp::fault_of(inputs, outputs))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, fault);
  return fp::guarded(error, [&] {
    std::unique_ptr<fragprune_state> keep(state ? new fragprune_state : nullptr);
    fp::forward(*inputs, *outputs, keep.get());
    if (state) *state = keep.release();
  });
}

int fragprune_backward(const fragprune_state* state, const fragprune_output_grads* output_grads,
                       const fragprune_input_grads* input_grads, int32_t threads,
                       fragprune_error* error) {
  if (!state || !output_grads || output_grads->size != sizeof *output_grads || !input_grads ||
      input_grads->size != sizeof *input_grads)
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, "structs of another version of fragprune.h");
  if (input_grads->thresholds && !(state->in.thresholds && state->in.widen))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, "the forward pass did not widen for thresholds");
  if ((input_grads->sh && !state->in.sh) || (input_grads->cov3d && !state->in.cov3d) ||
      ((input_grads->scales || input_grads->rotations) && !state->in.scales))
    return fp::fail(error, FRAGPRUNE_BAD_INPUT, "a gradient of something that was not given");
  return fp::guarded(error, [&] { fp::backward(*state, *output_grads, *input_grads, threads); });
}

void fragprune_free(fragprune_state* state) { delete state; }

int fragprune_version(void) { return FRAGPRUNE_API_VERSION; }

int fragprune_lanes(void) { return fp::kLanes; }

int fragprune_cpu_features(void) {
  int features = 0;
#if defined(__x86_64__) || defined(__i386__)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                    __builtin_cpu_supports("bmi2");
  if (avx2) features |= FRAGPRUNE_CPU_AVX2;
  if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw"))
    features |= FRAGPRUNE_CPU_AVX512;
#endif
  return features;
}

}  // extern "C"
