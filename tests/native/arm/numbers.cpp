// Draws random scenes and writes every number that comes out, to compare builds with each other.
//
//     numbers FILE [first seed] [scenes]
//
// FILE gets, for each array: its length (int64) and its elements as floats.

#include "calls.h"

namespace {

template <class T>
void write(std::FILE* file, const calls::Array<T>& array) {
  const int64_t length = array.length();
  CALLS_CHECK(std::fwrite(&length, sizeof length, 1, file) == 1);
  for (size_t i = 0; i < array.size(); i++) {
    const float number = static_cast<float>(array[i]);
    CALLS_CHECK(std::fwrite(&number, sizeof number, 1, file) == 1);
  }
}

void draw(uint64_t seed, std::FILE* file) {
  calls::Source from(seed);
  calls::Scene s = calls::make_scene(from, {300, 60});
  calls::Picture p = calls::make_picture(s, 0);
  fragprune_state* state = nullptr;
  CALLS_CHECK(fragprune_forward(&s.in, &p.out, &state, nullptr) == FRAGPRUNE_OK);
  check(s, p);
  const calls::Loss loss = make_loss(s, from, 0);
  const calls::Gradients g = differentiate(s, state, loss, 0, s.in.threads);
  fragprune_free(state);
  for (const calls::Floats* each : {&p.image, &p.invdepth, &p.alpha, &p.features, &p.weights})
    write(file, *each);
  for (const calls::Integers* each : {&p.radii, &p.fragments}) write(file, *each);
  for (const calls::Floats* each : g.all()) write(file, *each);
}

}  // namespace

int main(int argc, char** argv) {
  CALLS_CHECK(argc > 1);
  const uint64_t seed = argc > 2 ? std::strtoull(argv[2], nullptr, 10) : 0;
  const uint64_t scenes = argc > 3 ? std::strtoull(argv[3], nullptr, 10) : 40;
  std::FILE* file = std::fopen(argv[1], "wb");
  CALLS_CHECK(file);
  for (uint64_t k = 0; k < scenes; k++) {
    calls::seed_in_hand = seed + k;
    draw(calls::seed_in_hand, file);
  }
  CALLS_CHECK(std::fclose(file) == 0);
}
