// Surfels, drawn tile by tile; and back.
#pragma once

#include <atomic>
#include <memory>
#include <numeric>
#include <stdexcept>
#include <vector>

#include "surfel.h"
#include "threads.h"

namespace fp {

constexpr int kSurface = 6;  // depth, normal (3), median depth, distortion
constexpr int32_t kNever = INT32_MAX;

// ---- forward ---------------------------------------------------------------------------------

// What the forward pass leaves of a tile, by place.
struct SurfelPixels {
  float light[kPixels];        // final transmittance
  float first[kPixels], second[kPixels];  // sums of w d, w d^2; see surfel_slope
  int32_t stop[kPixels];       // fragments at this place of the list or later are not alive
  int32_t median[kPixels];     // place of the median depth's fragment; -1
};

struct SurfelScene {
  Memory memory;
  fragprune_inputs in;
  std::vector<Surfel> surfels;      // front to back
  std::vector<uint32_t> first;      // per tile, one more at the end
  std::vector<uint32_t> list;       // surfels
  Buffer<SurfelPixels> pixels;      // per tile
  size_t slots = 0;
  int tiles_x = 0, tiles_y = 0;
};

inline void list_surfels(SurfelScene& scene) {
  const auto tiles_of = [&](const Surfel& s, auto work) {
    for (int y = s.y0 / kTile; y <= (s.y1 - 1) / kTile; y++)
      for (int x = s.x0 / kTile; x <= (s.x1 - 1) / kTile; x++)
        work(static_cast<size_t>(y) * static_cast<size_t>(scene.tiles_x) + static_cast<size_t>(x));
  };
  const size_t tiles = static_cast<size_t>(scene.tiles_x) * static_cast<size_t>(scene.tiles_y);
  std::vector<uint64_t> counts(tiles + 1);
  for (Surfel& s : scene.surfels) {
    s.slot = static_cast<uint32_t>(scene.slots);
    scene.slots += static_cast<size_t>(s.tiles());
    tiles_of(s, [&](size_t t) { counts[t + 1]++; });
  }
  if (scene.slots > UINT32_MAX) throw std::length_error("tile lists");
  std::partial_sum(counts.begin(), counts.end(), counts.begin());
  scene.first.assign(counts.begin(), counts.end());
  scene.list.resize(scene.slots);
  std::vector<uint32_t> cursor(scene.first.begin(), scene.first.end() - 1);
  for (size_t j = 0; j < scene.surfels.size(); j++)
    tiles_of(scene.surfels[j],
             [&](size_t t) { scene.list[cursor[t]++] = static_cast<uint32_t>(j); });
}

inline void prepare_surfels(Team& team, const fragprune_inputs& in, int32_t* radii,
                            SurfelScene& scene) {
  const size_t n = static_cast<size_t>(in.count);
  Buffer<Surfel> all(scene.memory, n);
  std::vector<uint8_t> lives(n);
  team.each(n, 256, [&](size_t begin, size_t end) {
    for (size_t i = begin; i < end; i++) lives[i] = prepare_surfel(in, i, radii[i], all[i]);
  });
  std::vector<uint32_t> order;
  for (size_t i = 0; i < n; i++)
    if (lives[i]) order.push_back(static_cast<uint32_t>(i));
  std::sort(order.begin(), order.end(), [&](uint32_t a, uint32_t b) {
    return all[a].order != all[b].order ? all[a].order < all[b].order : a < b;
  });
  scene.surfels.reserve(order.size());
  for (uint32_t i : order) scene.surfels.push_back(all[i]);
  list_surfels(scene);
}

// Sums of one surfel over one tile, if they are wanted.
struct SurfelFound {
  Buffer<int32_t> fragments;
  Buffer<float> weights;
};

struct SurfelSpent {
  int64_t drawn = 0, evaluated = 0, entries = 0;
};

template <bool kStop>
inline SurfelSpent draw_surfel_tile(SurfelScene& scene, size_t t, const fragprune_outputs& out,
                                    SurfelFound& found) {
  const fragprune_inputs& in = scene.in;
  const int tile_x = static_cast<int>(t) % scene.tiles_x * kTile;
  const int tile_y = static_cast<int>(t) / scene.tiles_x * kTile;
  const int wide = std::min(kTile, in.width - tile_x), high = std::min(kTile, in.height - tile_y);
  SurfelPixels& kept = scene.pixels[t];
  // red, green, blue, 1/z; depth, normal, median depth, distortion
  alignas(64) float sums[4 + kSurface][kPixels] = {};
  alignas(64) float most[kPixels] = {};
  alignas(64) int32_t drawn_count[kPixels] = {}, winner[kPixels];
  std::fill_n(winner, kPixels, -1), std::fill_n(kept.median, kPixels, -1);
  std::fill_n(kept.first, kPixels, 0.f), std::fill_n(kept.second, kPixels, 0.f);
  std::fill_n(kept.light, kPixels, 1.f), std::fill_n(kept.stop, kPixels, 0);
  for (int y = 0; y < high; y++)
    for (int x = 0; x < wide; x++) kept.stop[place_of(x, y)] = kNever;
  const auto all = [](float x) { return broadcast<Lanes>(x); };
  const Lanes floor = all(kStop ? in.stop : kTransmittanceMin);
  const bool surface = out.surface != nullptr, scores = out.winners || out.wins_per_gaussian;
  SurfelSpent spent;
  const uint32_t begin = scene.first[t], end = scene.first[t + 1];
  int stopped = kPixels - wide * high;
  for (uint32_t e = begin; e < end && stopped < kPixels; e++) {
    const Surfel& s = scene.surfels[scene.list[e]];
    const int32_t place = static_cast<int32_t>(e - begin);
    int32_t fragments = 0;
    Lanes weights = all(0.f);
    spent.entries++;
    each_block(s, tile_x, tile_y, [&](int at, Lanes px, Lanes py) {
      spent.evaluated += kLanes;
      const IntLanes stop = load(kept.stop + at);
      Mask alive = gt(stop, broadcast_int(place));
      if (!bits(alive)) return;
      const SurfelMeeting m = meet_surfel(s, px, py, in.near);
      const Mask inside = both(both(m.met, alive), ge(all(s.cut), m.q));
      if (!bits(inside)) return;
      const Lanes alpha = where(inside, capped(all(s.opacity) * surfel_falloff(m.q), in.alpha_max));
      const Lanes light = load(kept.light + at), after = fnma(light, alpha, light);
      const Mask goes_on = both(alive, ge(after, floor)), draws = kStop ? alive : goes_on;
      const Mask drawn = both(inside, draws);
      const uint32_t ends = bits(alive) & ~bits(goes_on);
      if (ends) {
        const IntLanes here = broadcast_int(place + kStop);
        store(kept.stop + at, select(goes_on, stop, select(alive, here, stop)));
        stopped += __builtin_popcount(ends);
      }
      const Lanes weight = where(drawn, alpha * light);
      store(kept.light + at, select(draws, after, light));
      store(drawn_count + at, increment(drawn, load(drawn_count + at)));
      const auto add = [&](int k, Lanes value) {
        store(sums[k] + at, fma(weight, value, load(sums[k] + at)));
      };
      add(0, all(s.colour.x)), add(1, all(s.colour.y)), add(2, all(s.colour.z));
      if (out.invdepth) add(3, all(s.inv_z));
      if (surface) {
        const Lanes depth = select(drawn, m.depth, all(1.f));
        const Lanes d = all(surfel_slope(in.near)) / depth, used = all(1.f) - light;
        const Lanes first = load(kept.first + at), second = load(kept.second + at);
        add(4, depth);
        add(5, all(s.normal.x)), add(6, all(s.normal.y)), add(7, all(s.normal.z));
        add(9, fma(d, fma(d, used, -2.f * first), second));
        store(kept.first + at, fma(weight, d, first));
        store(kept.second + at, fma(weight * d, d, second));
        const Mask half = both(drawn, gt(light, all(0.5f)));
        store(sums[8] + at, select(half, depth, load(sums[8] + at)));
        store(kept.median + at, select(half, broadcast_int(place), load(kept.median + at)));
      }
      fragments += __builtin_popcount(bits(drawn));
      weights = weights + weight;
      if (scores) {
        const Lanes before = load(most + at);
        const auto id = broadcast_int(static_cast<int32_t>(s.id));
        store(winner + at, select(gt(weight, before), id, load(winner + at)));
        store(most + at, max(weight, before));
      }
    });
    spent.drawn += fragments;
    const uint32_t slot = s.slot_of(tile_x / kTile, tile_y / kTile);
    if (found.fragments.size()) found.fragments[slot] = fragments;
    if (found.weights.size()) found.weights[slot] = sum(weights);
  }
  const size_t plane = static_cast<size_t>(in.width) * static_cast<size_t>(in.height);
  for (int y = 0; y < high; y++)
    for (int x = 0; x < wide; x++) {
      const int i = place_of(x, y);
      const size_t at = static_cast<size_t>(tile_y + y) * static_cast<size_t>(in.width) +
                        static_cast<size_t>(tile_x + x);
      for (int k = 0; k < 3; k++)
        out.image[k * plane + at] = sums[k][i] + kept.light[i] * in.background[k];
      if (out.invdepth) out.invdepth[at] = sums[3][i];
      if (out.alpha) out.alpha[at] = 1.f - kept.light[i];
      for (int k = 0; surface && k < kSurface; k++) out.surface[k * plane + at] = sums[4 + k][i];
      if (out.fragments) out.fragments[at] = drawn_count[i];
      if (out.winners) out.winners[at] = winner[i];
      if (out.wins_per_gaussian && winner[i] >= 0)
        __atomic_fetch_add(out.wins_per_gaussian + winner[i], 1, __ATOMIC_RELAXED);
    }
  return spent;
}

// Draws; returns what the way back needs.
FP_STAGE inline std::unique_ptr<SurfelScene> draw_surfels(const fragprune_inputs& in,
                                                          fragprune_outputs& out,
                                                          const Memory& memory) {
  Team team(in.threads);
  auto scene = std::make_unique<SurfelScene>();
  scene->memory = memory, scene->in = in;
  scene->tiles_x = (in.width + kTile - 1) / kTile, scene->tiles_y = (in.height + kTile - 1) / kTile;
  prepare_surfels(team, in, out.radii, *scene);
  const size_t n = static_cast<size_t>(in.count), tiles = scene->first.size() - 1;
  scene->pixels = Buffer<SurfelPixels>(memory, tiles);
  SurfelFound found;
  if (out.fragments_per_gaussian) {
    found.fragments = Buffer<int32_t>(memory, scene->slots);
    std::fill_n(found.fragments.data(), scene->slots, 0);
    std::fill_n(out.fragments_per_gaussian, n, 0);
  }
  if (out.weights_per_gaussian) {
    found.weights = Buffer<float>(memory, scene->slots);
    std::fill_n(found.weights.data(), scene->slots, 0.f);
    std::fill_n(out.weights_per_gaussian, n, 0.f);
  }
  if (out.wins_per_gaussian) std::fill_n(out.wins_per_gaussian, n, 0);
  std::atomic<int64_t> drawn{0}, evaluated{0}, entries{0};
  team.each(tiles, 1, [&](size_t t, size_t) {
    const SurfelSpent spent = in.stop > 0 ? draw_surfel_tile<true>(*scene, t, out, found)
                                          : draw_surfel_tile<false>(*scene, t, out, found);
    drawn += spent.drawn, evaluated += spent.evaluated, entries += spent.entries;
  });
  for (const Surfel& s : scene->surfels)
    for (uint32_t slot = s.slot; slot < s.slot + static_cast<uint32_t>(s.tiles()); slot++) {
      if (out.fragments_per_gaussian) out.fragments_per_gaussian[s.id] += found.fragments[slot];
      if (out.weights_per_gaussian) out.weights_per_gaussian[s.id] += found.weights[slot];
    }
  out.drawn = drawn, out.evaluated = evaluated, out.entries = entries;
  return scene;
}

// ---- backward --------------------------------------------------------------------------------

inline void undraw_surfel_tile(const SurfelScene& scene, size_t t, const fragprune_output_grads& by,
                               bool rim, float* slots, double* by_background) {
  const fragprune_inputs& in = scene.in;
  const int tile_x = static_cast<int>(t) % scene.tiles_x * kTile;
  const int tile_y = static_cast<int>(t) / scene.tiles_x * kTile;
  const int wide = std::min(kTile, in.width - tile_x), high = std::min(kTile, in.height - tile_y);
  const size_t plane = static_cast<size_t>(in.width) * static_cast<size_t>(in.height);
  const SurfelPixels& kept = scene.pixels[t];
  alignas(64) float g[4 + kSurface][kPixels] = {};  // as in draw_surfel_tile
  alignas(64) float light[kPixels], behind[kPixels] = {};
  for (int k = 0; k < 3; k++) by_background[k] = 0;
  int32_t last = 0;
  std::copy_n(kept.light, kPixels, light);
  for (int y = 0; y < high; y++)
    for (int x = 0; x < wide; x++) {
      const int i = place_of(x, y);
      const size_t at = static_cast<size_t>(tile_y + y) * static_cast<size_t>(in.width) +
                        static_cast<size_t>(tile_x + x);
      float seen = by.alpha ? -by.alpha[at] : 0.f;
      for (int k = 0; k < 3; k++) {
        g[k][i] = by.image ? by.image[k * plane + at] : 0.f;
        seen += g[k][i] * in.background[k];
        by_background[k] += light[i] * g[k][i];
      }
      g[3][i] = by.invdepth ? by.invdepth[at] : 0.f;
      for (int k = 0; by.surface && k < kSurface; k++) g[4 + k][i] = by.surface[k * plane + at];
      behind[i] = light[i] * seen;
      last = std::max(last, kept.stop[i]);
    }
  const auto all = [](float x) { return broadcast<Lanes>(x); };
  const float per_fragment = by.fragments_per_pixel / static_cast<float>(plane);
  const int32_t length = static_cast<int32_t>(scene.first[t + 1] - scene.first[t]);
  for (int32_t place = std::min(last, length) - 1; place >= 0; place--) {
    const Surfel& s = scene.surfels[scene.list[scene.first[t] + static_cast<uint32_t>(place)]];
    Lanes sums[kSurfelSums];
    for (Lanes& v : sums) v = all(0.f);
    each_block(s, tile_x, tile_y, [&](int at, Lanes px, Lanes py) {
      const Mask alive = gt(load(kept.stop + at), broadcast_int(place));
      if (!bits(alive)) return;
      const SurfelMeeting m = meet_surfel(s, px, py, in.near);
      const Mask reached = both(m.met, alive);
      if (!bits(reached)) return;
      const Mask drawn = both(reached, ge(all(s.cut), m.q));
      const Lanes one = all(1.f);
      const Lanes falloff = surfel_falloff(select(reached, m.q, all(0.f)));
      const Lanes uncapped = all(s.opacity) * falloff, full = capped(uncapped, in.alpha_max);
      const Lanes alpha = where(drawn, full), inv = one / (one - alpha);
      const Lanes after = load(light + at), before = after * inv;
      const auto loss = [&](int k) { return load(g[k] + at); };
      const Lanes depth = select(reached, m.depth, one);
      Lanes shade = loss(0) * all(s.colour.x) + loss(1) * all(s.colour.y) +
                    loss(2) * all(s.colour.z) + loss(3) * all(s.inv_z);
      Lanes by_depth = all(0.f);
      const Lanes weight = alpha * before;
      if (by.surface) {
        const Lanes d = all(surfel_slope(in.near)) / depth, used = one - load(kept.light + at);
        const Lanes first = load(kept.first + at), distortion = loss(9);
        shade = shade + loss(4) * depth + loss(5) * all(s.normal.x) + loss(6) * all(s.normal.y) +
                loss(7) * all(s.normal.z) +
                distortion * fma(d, fma(d, used, -2.f * first), load(kept.second + at));
        by_depth = weight * (loss(4) - 2.f * distortion * fma(d, used, -first) * d / depth);
        const IntLanes median = load(kept.median + at);
        const Mask other = gt(median, broadcast_int(place));  // behind
        const Mask here = both(gt(median, broadcast_int(place - 1)), drawn);
        by_depth = by_depth + select(other, all(0.f), where(here, loss(8)));
        for (int k = 0; k < 3; k++)
          sums[kByNormal + k] = fma(weight, loss(5 + k), sums[kByNormal + k]);
      }
      // What a pixel's stop left out is taken to look like the last fragment.
      const Mask goes_on = gt(load(kept.stop + at), broadcast_int(place + (in.stop > 0)));
      const Lanes later = select(goes_on, load(behind + at), after * shade);
      const Lanes by_alpha = fnma(later, inv, before * shade);
      store(light + at, select(drawn, before, after));
      store(behind + at, fma(weight, shade, later));
      for (int k = 0; k < 3; k++)
        sums[kByColour + k] = fma(weight, loss(k), sums[kByColour + k]);
      sums[kByInvZ] = fma(weight, loss(3), sums[kByInvZ]);
      Lanes w = where(drawn, uncapped * by_alpha);  // straight through the cap
      if (!in.cap_gradient) w = where(ge(all(in.alpha_max), uncapped), w);
      sums[kByOpacity] = sums[kByOpacity] + w;
      if (rim) {
        const Lanes away = abs(falloff - all(s.threshold));
        const Mask near = both(reached, ge(all(kRimHorizon), away));
        const Lanes gain = fma(full, by_alpha, all(per_fragment));
        sums[kByThreshold] = sums[kByThreshold] - where(near, gain * rim_density(away));
      }
      // q = u^2 + v^2 or 2 |centre - pixel|^2, and dL/dq = -w / 2
      const Mask plane_drawn = both(drawn, m.on_plane);
      const Lanes round = select(m.on_plane, all(0.f), w * all(-kSurfelFilter));
      sums[kByCentre] = sums[kByCentre] + where(drawn, round * m.dx);
      sums[kByCentre + 1] = sums[kByCentre + 1] + where(drawn, round * m.dy);
      const Lanes u = where(drawn, m.u), v = where(drawn, m.v);
      const Lanes by_u = where(plane_drawn, (by_depth * all(s.depth.x) - w * u) * m.inv);
      const Lanes by_v = where(plane_drawn, (by_depth * all(s.depth.y) - w * v) * m.inv);
      const Lanes by_point[3] = {by_u, by_v, -(by_u * u + by_v * v)};
      const Lanes x = px - all(s.shift_x), y = py - all(s.shift_y);
      const Lanes by_row[3] = {by_depth * u, by_depth * v, by_depth};
      for (int k = 0; k < 3; k++) {
        sums[kByOrigin + k] = sums[kByOrigin + k] + by_point[k];
        sums[kByX + k] = fma(x, by_point[k], sums[kByX + k]);
        sums[kByY + k] = fma(y, by_point[k], sums[kByY + k]);
        sums[kByDepth + k] = sums[kByDepth + k] + where(drawn, by_row[k]);
      }
    });
    sum_each<kSurfelSums>(sums, slots + size_t{kSurfelSums} *
                                            s.slot_of(tile_x / kTile, tile_y / kTile));
  }
}

FP_STAGE inline void undraw_surfels(const SurfelScene& scene, const fragprune_output_grads& by,
                                    const fragprune_input_grads& to, int threads) {
  Team team(threads);
  const fragprune_inputs& in = scene.in;
  const size_t n = static_cast<size_t>(in.count), tiles = scene.first.size() - 1;
  const ShRows<float> by_sh = coefficient_rows(in, to);
  const std::pair<float*, size_t> arrays[] = {
      {to.means, 3},     {to.hook, 3}, {to.opacities, 1}, {to.scales, 2},
      {to.rotations, 4}, {by_sh.part[0].rows, by_sh.part[0].width},
      {by_sh.part[1].rows, by_sh.part[1].width}, {to.colors, 3},    {to.thresholds, 1}};
  for (const auto& [data, width] : arrays)
    if (data) std::fill_n(data, n * width, 0.f);
  Buffer<float> slots(scene.memory, scene.slots * kSurfelSums);
  team.each(slots.size(), 1u << 18,
            [&](size_t begin, size_t end) { std::fill(&slots[begin], slots.data() + end, 0.f); });
  std::vector<double> by_background(3 * tiles);
  team.each(tiles, 1, [&](size_t t, size_t) {
    undraw_surfel_tile(scene, t, by, to.thresholds != nullptr, slots.data(), &by_background[3 * t]);
  });
  if (to.background)
    for (size_t k = 0; k < 3; k++) {
      double total = 0;
      for (size_t t = 0; t < tiles; t++) total += by_background[3 * t + k];
      to.background[k] = static_cast<float>(total);
    }
  team.each(scene.surfels.size(), 256, [&](size_t begin, size_t end) {
    for (size_t j = begin; j < end; j++) {
      const Surfel& s = scene.surfels[j];
      double sums[kSurfelSums] = {};
      const float* mine = slots.data() + size_t{s.slot} * kSurfelSums;
      for (int k = 0; k < s.tiles(); k++, mine += kSurfelSums)
        for (int m = 0; m < kSurfelSums; m++) sums[m] += mine[m];
      unproject_surfel(in, s, sums, to);
    }
  });
}

}  // namespace fp
