// Any bytes whatever become one call of the C interface: sizes and choices clamped to what the
// contract allows, every float as the bytes have it.
//
// With -DFUZZ_LIBFUZZER, libFuzzer's main drives it (docs/how-to/sanitize.md has the command).
// Without, a main of its own:
//
//     fuzz_target FILE...                           replays inputs, such as a crash that libFuzzer found
//     fuzz_target --seed S --inputs N --seconds T   makes up to N inputs of its own

#include <chrono>
#include <string>

#include "calls.h"

namespace {

// The bytes as they are, or, by a bit of `raw`, read as numbers near one: both reach deep.
void take(calls::Floats& array, size_t size, calls::Source& from, uint32_t& raw) {
  array.make(size);
  const bool as_they_are = raw & 1;
  raw = raw >> 1 | raw << 31;
  for (size_t i = 0; i < size; i++) {
    const uint32_t word = from.next();
    if (as_they_are)
      std::memcpy(&array[i], &word, sizeof word);
    else
      array[i] = (static_cast<int>(word % 1025) - 512) / 256.f;
  }
}

calls::Scene scene_of(calls::Source& from) {
  calls::Scene s;
  s.tame = false;
  fragprune_inputs& in = s.in;
  const uint32_t shape = from.next(), options = from.next();
  uint32_t raw = from.next() & from.next();
  in.size = sizeof in;
  in.width = 1 + shape % 48;
  in.height = 1 + shape / 48 % 48;
  in.count = shape / (48 * 48) % 33;
  in.threads = 1 + static_cast<int>(options % 5);
  in.compensation = static_cast<int>((options >> 12 & 3) % 3);
  in.cap_gradient = options >> 14 & 1;
  in.absolute_gradient = options >> 15 & 1;
  in.feature_count = static_cast<int>((options >> 16 & 15) % 9);
  in.widen = options >> 4 & 1;
  in.sh_degree = options >> 5 & 3;
  in.sh_coefficients = (in.sh_degree + 1) * (in.sh_degree + 1) + (options >> 7 & 3);
  const size_t n = s.count();
  calls::Floats numbers;
  take(numbers, 6, from, raw);
  in.tan_fov_x = numbers[0], in.tan_fov_y = numbers[1];
  in.scale_modifier = numbers[2], in.dilation = numbers[3];
  in.near = numbers[4] >= 0 ? numbers[4] : 0.2f;
  in.alpha_max = numbers[5] >= 0.01f && numbers[5] <= 1 ? numbers[5] : 0.99f;
  in.soft = options >> 24 & 1;
  in.stop = options >> 23 & 1 ? 0.3f : 0;
  if (in.stop > 0) in.alpha_max = std::min(in.alpha_max, (float)FRAGPRUNE_STOPPED_ALPHA_MAX);
  take(s.viewmatrix, 16, from, raw);
  take(s.projmatrix, 16, from, raw);
  take(s.campos, 3, from, raw);
  take(s.background, 3, from, raw);
  take(s.opacities, n, from, raw);
  if (options >> 20 & 1) {
    take(s.means2d, 2 * n, from, raw);
    take(s.conics, 3 * n, from, raw);
    take(s.depths, n, from, raw);
    take(s.colors, 3 * n, from, raw);
    s.tiles.make(4 * n);
    for (size_t i = 0; i < 4 * n; i++) {
      const uint32_t word = from.next();
      s.tiles[i] = raw & 1 ? static_cast<int32_t>(word) : static_cast<int32_t>(word % 7) - 1;
    }
  } else {
    take(s.means, 3 * n, from, raw);
    if (options >> 9 & 1) {
      take(s.cov3d, 6 * n, from, raw);
    } else {
      in.flat = options >> 22 & 1;
      take(s.scales, (in.flat ? 2 : 3) * n, from, raw);
      take(s.rotations, 4 * n, from, raw);
    }
    if (options >> 10 & 1)
      take(s.colors, 3 * n, from, raw);
    else
      take(s.sh, 3 * n * in.sh_coefficients, from, raw);
  }
  if (options >> 11 & 1) take(s.thresholds, n, from, raw);
  if (in.flat) in.feature_count = in.compensation = in.absolute_gradient = in.soft = 0;
  if (in.feature_count) take(s.features, n * in.feature_count, from, raw);
  if (options >> 21 & 1 && !in.flat) {
    take(s.offsets, 2 * s.pixels(), from, raw);
    for (size_t i = 0; i < s.offsets.size(); i++)
      if (!(std::fabs(s.offsets[i]) <= 1e6f)) s.offsets[i] = 0;  // the contract's
  }
  s.point();
  return s;
}

calls::Tally total;

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  calls::Source from(data, size);
  calls::run(scene_of(from), from, total);
  return 0;
}

#ifndef FUZZ_LIBFUZZER

namespace {

std::vector<uint8_t> contents(const char* path) {
  std::vector<uint8_t> bytes;
  FILE* file = std::fopen(path, "rb");
  if (!file) {
    std::perror(path);
    std::exit(2);
  }
  for (int c; (c = std::fgetc(file)) != EOF;) bytes.push_back(static_cast<uint8_t>(c));
  std::fclose(file);
  return bytes;
}

// A failure names the seed in hand; --seed S --inputs 1 repeats it.
void generate(uint64_t seed, double seconds, uint64_t inputs) {
  using Clock = std::chrono::steady_clock;
  const auto started = Clock::now();
  for (; inputs > 0; inputs--, seed++) {
    if (std::chrono::duration<double>(Clock::now() - started).count() >= seconds) break;
    calls::seed_in_hand = seed;
    calls::Source dice(seed);
    std::vector<uint8_t> bytes(dice.below(8192));
    for (uint8_t& byte : bytes) byte = static_cast<uint8_t>(dice.next());
    LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
  }
}

}  // namespace

int main(int argc, char** argv) {
  calls::name_the_seed_on_death();
  uint64_t seed = 0, inputs = 0;
  double seconds = 1e9;
  for (int i = 1; i < argc; i++) {
    const std::string argument = argv[i];
    const char* value = i + 1 < argc ? argv[i + 1] : "";
    if (argument == "--seed") {
      seed = std::strtoull(value, nullptr, 10), i++;
    } else if (argument == "--inputs") {
      inputs = std::strtoull(value, nullptr, 10), i++;
    } else if (argument == "--seconds") {
      seconds = std::atof(value), i++;
    } else {
      const std::vector<uint8_t> bytes = contents(argv[i]);
      LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
    }
  }
  generate(seed, seconds, inputs);
  total.print();
}

#endif
