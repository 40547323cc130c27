// Draws one scene again and again, to count instructions: frames TRUNCATED FRAMES
//
// 20,000 Gaussians of a few pixels on 256x256 pixels, on one thread, colour alone. With TRUNCATED 1
// every Gaussian is cut at a falloff of 0.12.

#include "calls.h"

int main(int argc, char** argv) {
  CALLS_CHECK(argc > 2);
  const bool truncated = argv[1][0] == '1';
  const int frames = std::atoi(argv[2]);
  constexpr int side = 256, count = 20'000;
  calls::Source from(7);
  calls::Scene s;
  s.in.size = sizeof s.in;
  s.in.threads = 1, s.in.width = s.in.height = side, s.in.count = count;
  s.in.scale_modifier = 1, s.in.dilation = 0.3f, s.in.near = 0.2f, s.in.alpha_max = 0.99f;
  s.in.tan_fov_x = s.in.tan_fov_y = 0.5f;
  float view[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 4, 1};
  float full[16] = {2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1, 1, 0, 0, 3.99f, 4};
  s.viewmatrix.make(16), s.projmatrix.make(16);
  std::memcpy(s.viewmatrix.get(), view, sizeof view);
  std::memcpy(s.projmatrix.get(), full, sizeof full);
  fill(s.campos, 3, from, 0, 0), fill(s.background, 3, from, 0, 0);
  s.campos[2] = -4;
  fill(s.means, 3 * count, from, -1.6f, 1.6f);
  fill(s.opacities, count, from, 0.05f, 0.95f);
  fill(s.scales, 3 * count, from, 0.01f, 0.08f);
  s.rotations.make(4 * count);
  for (size_t i = 0; i < count; i++) calls::unit_quaternion(from, &s.rotations[4 * i]);
  s.in.sh_degree = 1, s.in.sh_coefficients = 4;
  fill(s.sh, 3 * count * 4, from, -0.5f, 0.5f);
  if (truncated) fill(s.thresholds, count, from, 0.12f, 0.12f);
  s.point();
  const calls::Workspace workspace = calls::new_workspace();
  s.in.workspace = workspace.get();
  calls::Floats image;
  calls::Integers radii;
  image.make(3 * side * side), radii.make(count);
  fragprune_outputs out{};
  out.size = sizeof out, out.image = image.get(), out.radii = radii.get();
  fragprune_error error;
  for (int k = 0; k < frames; k++)
    if (fragprune_forward(&s.in, &out, nullptr, &error) != FRAGPRUNE_OK)
      calls::fail(error.message, __FILE__, __LINE__);
  std::printf("drawn %lld evaluated %lld\n", (long long)out.drawn, (long long)out.evaluated);
}
