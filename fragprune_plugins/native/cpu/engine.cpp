// The C interface on a CPU: project, sort, bin, blend; and back.

#include <array>
#include <chrono>
#include <cstdio>
#include <new>
#include <stdexcept>
#include <utility>

#include "binning.h"
#include "blend.h"

struct fragprune_workspace {
  fp::Memory memory = std::make_shared<fp::Pool>();
};

struct fragprune_state {
  fp::Memory memory;
  fragprune_inputs in;
  fp::Camera<float> camera;
  fp::Scene scene;  // what backward needs of it
  fp::TileLists lists;
  fp::Buffer<size_t> words;           // per tile: where its bits begin
  fp::Buffer<uint64_t> reached;       // see find_blocks
  fp::Buffer<fp::TilePixels> pixels;  // per tile
};

namespace fp {
namespace {

// ---- forward ---------------------------------------------------------------------------------

Tile tile_at(const Camera<float>& c, const TileLists& lists, size_t t) {
  const uint32_t first = lists.first[t];
  const size_t across = static_cast<size_t>(c.tiles_x);
  return {static_cast<int>(t % across) * kTile, static_cast<int>(t / across) * kTile,
          lists.splat.data() + first, static_cast<int>(lists.first[t + 1] - first)};
}

void draw(Team& team, const Camera<float>& c, const fragprune_inputs& in,
          const Buffer<Splat>& splats, const TileLists& lists, fragprune_outputs& out, fragprune_state* keep) {
  const float* back = in.background;
  const Canvas canvas{in.width,  in.height,    {back[0], back[1], back[2]},
                      out.image, out.invdepth, out.alpha, out.fragments};
  const size_t tiles = lists.tiles();
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

// Milliseconds since the last call.
class Clock {
 public:
  float lap() {
    const auto now = std::chrono::steady_clock::now();
    const std::chrono::duration<float, std::milli> spent = now - last_;
    last_ = now;
    return spent.count();
  }

 private:
  std::chrono::steady_clock::time_point last_ = std::chrono::steady_clock::now();
};

// Room for what the tiles keep for the backward pass.
void prepare(fragprune_state& keep, const TileLists& lists) {
  const size_t tiles = lists.tiles();
  keep.words = Buffer<size_t>(keep.memory, tiles);
  size_t words = 0;
  for (size_t t = 0; t < tiles; t++) {
    keep.words[t] = words;
    words += (lists.first[t + 1] - lists.first[t] + kWord - 1) / kWord * kBlocks;
  }
  keep.reached = Buffer<uint64_t>(keep.memory, words);
  keep.pixels = Buffer<TilePixels>(keep.memory, tiles);
}

void forward(const fragprune_inputs& in, fragprune_outputs& out, const Memory& memory,
             fragprune_state* keep) {
  Clock clock;
  Team team(in.threads);
  const Camera<float> camera = unpack_camera(in);
  // A state holds on to its memory until the backward pass is done, which then wants more: what the
  // forward pass alone needed goes back to the system first, lest both lie idle in turns.
  Memory scratch = keep ? std::make_shared<Pool>() : memory;
  Scene scene = project_all(team, memory, scratch, camera, in, out.radii);
  out.projection_ms = clock.lap();
  const size_t across = static_cast<size_t>(camera.tiles_x);
  TileLists lists = distribute(team, memory, scratch, across, scene, keep != nullptr);
  scene.drop_reach();
  scratch.reset();
  out.binning_ms = clock.lap();
  if (out.fragments_per_gaussian)
    std::fill_n(out.fragments_per_gaussian, static_cast<size_t>(in.count), 0);
  if (keep) prepare(*keep, lists);
  draw(team, camera, in, scene.splats, lists, out, keep);
  if (keep) {
    keep->in = in;
    keep->camera = camera;
    keep->scene = std::move(scene);
    keep->lists = std::move(lists);
  }
  out.blend_ms = clock.lap();
}

// ---- backward --------------------------------------------------------------------------------

struct Losses {
  const fragprune_output_grads& grads;
  float background[3];
  size_t plane;
};

// One plane of the image into block order; pixels outside the image, and a plane of NULL, are 0.
void load_plane(const Camera<float>& c, const Tile& tile, const float* plane, float* to) {
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
void load_losses(const Camera<float>& c, const Losses& from, const Tile& tile,
                 const TilePixels& kept, LossPixels& to, double* by_background) {
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
                             const uint32_t*, float, LossPixels&, float*);

template <size_t... kWants>
constexpr std::array<UnblendTile, sizeof...(kWants)> unblenders(std::index_sequence<kWants...>) {
  return {unblend_tile<static_cast<int>(kWants)>...};
}

PixelSums<Lanes> unpack_sums(const Lanes* v, int want) {
  PixelSums<Lanes> s{};
  s.w = *v++;
  if (want & kThreshold) s.threshold = *v++;
  if (want & kGeometry) s.u = *v++, s.v = *v++, s.uu = *v++, s.uv = *v++, s.vv = *v++;
  if (want & kColour) s.r = *v++, s.g = *v++, s.b = *v++;
  if (want & kDepth && want & kGeometry) s.inv_z = *v++;
  return s;
}

// kLanes Gaussians by their rows of the inputs. `count` are meant; the others repeat the last.
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
};

// From the sums over pixels to the inputs.
class Chain {
 public:
  Chain(const fragprune_state& state, const fragprune_input_grads& to, int want)
      : in_(state.in), to_(to), want_(want), c_(lift<Lanes>(state.camera)),
        means_(in_.means, in_.count), scales_(in_.scales, in_.count) {}

  void run(const Picked& who, const PixelSums<Lanes>& sums) const {
    who.write<1>(to_.thresholds, &sums.threshold);
    if (to_.opacities) {  // alpha is proportional to it
      Lanes opacity;
      for (int i = 0; i < kLanes; i++) opacity[i] = in_.opacities[who.ids[i]];
      const Lanes by_opacity = sums.w / opacity;
      who.write<1>(to_.opacities, &by_opacity);
    }
    who.write(to_.colors, {sums.r, sums.g, sums.b});
    const bool by_colour = in_.sh && want_ & kColour;
    if (!(want_ & kGeometry) && !by_colour) return;
    Given<Lanes> given;
    given.mean = means_.load(who.ids);
    Vec<Lanes> by_mean = Vec<Lanes>();
    if (by_colour) by_mean = colour(who, given.mean, sums);
    if (want_ & kGeometry) geometry(who, given, by_mean, sums);
  }

 private:
  // Writes dL/dsh, returns dL/dmean through the direction.
  Vec<Lanes> colour(const Picked& who, const Vec<Lanes>& mean, const PixelSums<Lanes>& sums) const {
    const bool by_direction = to_.means && in_.sh_degree > 0;
    Lanes inv_length;
    const Vec<Lanes> direction = direction_to(c_, mean, inv_length);
    Harmonics<Lanes> h;
    const int terms = harmonics(in_.sh_degree, direction, h, by_direction);
    Coefficients coefficients;
    load_coefficients(in_, who.ids, terms, coefficients);
    const Vec<Lanes> g = through_clamp(raw_colour(h, terms, coefficients), sums);
    if (to_.sh) write_sh(who, h, terms, g);
    if (!by_direction) return Vec<Lanes>();
    return direction_gradient(h, terms, direction, inv_length, g, coefficients);
  }

  void write_sh(const Picked& who, const Harmonics<Lanes>& h, int terms,
                const Vec<Lanes>& g) const {
    Lanes column[48];
    for (int k = 0; k < terms; k++) {
      const Vec<Lanes> v = h.value[k] * g;
      column[3 * k] = v.x, column[3 * k + 1] = v.y, column[3 * k + 2] = v.z;
    }
    const size_t width = 3 * static_cast<size_t>(in_.sh_coefficients);
    const size_t used = 3 * static_cast<size_t>(terms);
    float scratch[48];  // where lanes go that are not meant
    const auto row = [&](int lane) {
      return lane < who.count ? to_.sh + who.ids[lane] * width : scratch;
    };
    if (used < 4) {
      for (int lane = 0; lane < who.count; lane++)
        for (size_t k = 0; k < used; k++) row(lane)[k] = column[k][lane];
    } else {
      for (size_t k = 0; k < used; k += 4) {
        const size_t from = std::min(k, used - 4);
        store_rows(column + from, [&](int lane) { return row(lane) + from; });
      }
    }
    if (used == width) return;
    for (int lane = 0; lane < who.count; lane++)
      std::fill(row(lane) + used, row(lane) + width, 0.f);
  }

  void geometry(const Picked& who, Given<Lanes>& given, const Vec<Lanes>& by_mean,
                const PixelSums<Lanes>& sums) const {
    given.factored = in_.cov3d == nullptr;
    if (given.factored) {
      given.scale = scales_.load(who.ids);
      const auto row = [&](int i) { return in_.rotations + 4 * size_t{who.ids[i]}; };
      load_columns(row, given.rotation);
    } else {
      const auto row = [&](int i) { return in_.cov3d + 6 * size_t{who.ids[i]}; };
      load_columns(row, given.cov3d);
      load_columns([&](int i) { return row(i) + 2; }, given.cov3d + 2);
    }
    Projection<Lanes> p;
    project(c_, given, p);
    const ImageGradient<Lanes> g = image_gradient(c_, p, sums);
    who.write(to_.means2d,
              {g.x * 0.5f * c_.width, g.y * 0.5f * c_.height, broadcast<Lanes>(0.f)});
    Mat3<Lanes> m;
    Vec<Lanes> view = shape_gradient(c_, p, shape_of(c_, given), g, m);
    view.z = view.z - sums.inv_z / (p.view.z * p.view.z);
    who.write(to_.means, by_mean + mean_gradient(c_, given.mean, g, view));
    if (to_.cov3d) {  // an off-diagonal entry stands for two
      const Lanes by[6] = {m.row[0].x, m.row[0].y + m.row[1].x, m.row[0].z + m.row[2].x,
                           m.row[1].y, m.row[1].z + m.row[2].y, m.row[2].z};
      who.write<6>(to_.cov3d, by);
    }
    if (to_.scales) {
      const Mat3<Lanes> r = rotation_of(given.rotation);
      const Vec<Lanes> by_size =
          times(r.row[0], m.row[0]) + times(r.row[1], m.row[1]) + times(r.row[2], m.row[2]);
      who.write(to_.scales, c_.scale_modifier * by_size);
    }
    if (to_.rotations) {
      const Vec<Lanes> size = c_.scale_modifier * given.scale;
      for (Vec<Lanes>& v : m.row) v = times(v, size);
      Lanes by[4];
      rotation_gradient(given.rotation, m, by);
      who.write<4>(to_.rotations, by);
    }
  }

  const fragprune_inputs& in_;
  const fragprune_input_grads& to_;
  const int want_;
  const Camera<Lanes> c_;
  const Triples means_, scales_;
};

// A slot's sums, and what happens to lie behind them.
typedef float Record __attribute__((vector_size(64)));
static_assert(sums_of(15) <= 16, "fits a Record");

Record load_record(const float* from) {
  Record r;
  std::memcpy(&r, from, sizeof r);
  return r;
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
  const size_t tiles = lists.tiles();
  const Losses losses{grads,
                      {in.background[0], in.background[1], in.background[2]},
                      static_cast<size_t>(in.width) * in.height};
  const float pixels = static_cast<float>(losses.plane);
  const float per_fragment = grads.fragments_per_pixel / pixels;
  Buffer<float> sums(state.memory, per_gaussian ? lists.splat.size() * size + 16 : 0);
  Buffer<double> by_background(state.memory, 3 * tiles);
  team.each(tiles, 1, [&](size_t t, size_t) {
    const Tile tile = tile_at(state.camera, lists, t);
    LossPixels loss;
    load_losses(state.camera, losses, tile, state.pixels[t], loss, &by_background[3 * t]);
    if (per_gaussian)
      table[want](state.scene.splats.data(), tile, state.pixels[t],
                  state.reached.data() + state.words[t], lists.slot.data() + lists.first[t],
                  per_fragment, loss, sums.data());
  });
  if (to.background)
    for (int k = 0; k < 3; k++) {
      double total = 0;
      for (size_t t = 0; t < tiles; t++) total += by_background[3 * t + k];
      to.background[k] = static_cast<float>(total);
    }
  if (!per_gaussian) return;
  const Chain chain(state, to, want);
  team.each(state.scene.pieces(), 1, [&](size_t piece, size_t) {
    const Scene& scene = state.scene;
    const size_t begin = piece * kPiece, end = begin + scene.count[piece];
    size_t row = begin;  // the first whose gradients are not written yet
    Picked who;
    who.count = 0;
    Lanes total[sums_of(15)] = {};
    const auto flush = [&] {
      for (int lane = who.count; lane < kLanes; lane++) who.ids[lane] = who.ids[who.count - 1];
      chain.run(who, unpack_sums(total, want));
      who.count = 0;
    };
    for (size_t k = begin; k < end; k++) {
      const uint32_t from = scene.slot_begin(k), until = scene.slot_end(k);
      if (from == until) continue;
      const size_t i = scene.splats[k].id;
      clear(row, i);
      row = i + 1;
      const float* v = sums.data() + static_cast<size_t>(from) * size;
      const float* last = sums.data() + static_cast<size_t>(until) * size;
      Record mine = {};
      for (; v < last; v += size) mine = mine + load_record(v);
      for (int s = 0; s < size; s++) total[s][who.count] = mine[s];
      who.ids[who.count++] = static_cast<uint32_t>(i);
      if (who.count == kLanes) flush();
    }
    if (who.count) flush();
    clear(row, std::min(begin + kPiece, n));
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
    const fp::Memory memory =
        inputs->workspace ? inputs->workspace->memory : std::make_shared<fp::Pool>();
    std::unique_ptr<fragprune_state> keep(state ? new fragprune_state : nullptr);
    if (keep) keep->memory = memory;
    fp::forward(*inputs, *outputs, memory, keep.get());
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

fragprune_workspace* fragprune_workspace_new(void) {
  try {
    return new fragprune_workspace;
  } catch (const std::bad_alloc&) {
    return nullptr;
  }
}

void fragprune_workspace_free(fragprune_workspace* workspace) { delete workspace; }

void* fragprune_workspace_take(fragprune_workspace* workspace, uint64_t bytes) {
  try {
    return workspace->memory->take(fp::Pool::class_of(bytes));
  } catch (const std::exception&) {
    return nullptr;
  }
}

void fragprune_workspace_give(fragprune_workspace* workspace, void* memory, uint64_t bytes) {
  if (memory) workspace->memory->put(memory, fp::Pool::class_of(bytes));
}

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
