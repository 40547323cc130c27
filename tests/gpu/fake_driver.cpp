// A libcuda.so.1 without a GPU: takes the calls of native/driver.py as the bindings make them, and
// runs kernels by their names, from the emulated libraries in the folder $FAKE_KERNELS.
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <filesystem>
#include <string>
#include <vector>

#define EXPORT extern "C" __attribute__((visibility("default")))

namespace {
constexpr int kInvalidValue = 1, kInvalidContext = 201, kInvalidImage = 200, kNotFound = 500;
constexpr int kIllegalAddress = 700;
bool failed() { return getenv("FAKE_FAILED") != nullptr; }  // an earlier kernel: all calls say so
int contexts[2];  // of two devices
thread_local std::vector<void*> stack;  // of contexts; the last is current
void* current() { return stack.empty() ? nullptr : stack.back(); }

struct Module {
  void* context;
  const char* kind;
};
struct Function {
  Module* module;
  std::string name;
};

// The library that has a kernel: the one whose launch knows its name.
int run(const std::string& name, unsigned blocks, unsigned threads, void* arguments) {
  for (const auto& entry : std::filesystem::directory_iterator(getenv("FAKE_KERNELS"))) {
    if (entry.path().extension() != ".so") continue;
    void* library = dlopen(entry.path().c_str(), RTLD_NOW | RTLD_LOCAL);
    using Knows = int (*)(const char*);
    using Launch = int (*)(const char*, unsigned, unsigned, const void*, unsigned, int);
    if (!reinterpret_cast<Knows>(dlsym(library, "emulated_knows"))(name.c_str())) continue;
    return reinterpret_cast<Launch>(dlsym(library, "emulated_launch"))(name.c_str(), blocks,
                                                                       threads, arguments, 1, 3);
  }
  return 1;
}
}  // namespace

EXPORT int cuInit(unsigned) { return 0; }
EXPORT int cuDriverGetVersion(int* version) { return *version = 13050, 0; }
EXPORT int cuDeviceGet(int* device, int ordinal) { return *device = ordinal, 0; }
EXPORT int cuDevicePrimaryCtxRetain(void** to, int device) {
  return *to = &contexts[device], 0;
}
EXPORT int cuCtxGetCurrent(void** to) { return *to = current(), 0; }
EXPORT int cuCtxSetCurrent(void* to) {
  if (!stack.empty()) stack.pop_back();
  return stack.push_back(to), 0;
}
EXPORT int cuCtxPushCurrent(void* to) { return stack.push_back(to), 0; }
EXPORT int cuCtxPopCurrent(void** to) {
  if (stack.empty()) return kInvalidContext;
  return *to = stack.back(), stack.pop_back(), 0;
}

EXPORT int cuCtxSynchronize() { return failed() ? kIllegalAddress : 0; }
EXPORT int cuModuleLoadData(void** module, const void* image) {
  if (!current()) return kInvalidContext;
  if (failed()) return kIllegalAddress;
  const char* refused = getenv("FAKE_REFUSES");  // machine code, as an old driver does new one
  const bool elf = memcmp(image, "\177ELF", 4) == 0;
  if (!elf && !strstr(static_cast<const char*>(image), ".version")) return kInvalidImage;
  if (elf && refused) return kInvalidImage;
  return *module = new Module{current(), elf ? "machine code" : "PTX"}, 0;
}
EXPORT int cuModuleGetFunction(void** function, void* module, const char* name) {
  if (strncmp(name, "fp_", 3)) return kNotFound;
  fprintf(stderr, "%s from %s\n", name, static_cast<Module*>(module)->kind);
  return *function = new Function{static_cast<Module*>(module), name}, 0;
}
EXPORT int cuLaunchKernel(void* function, unsigned x, unsigned y, unsigned z, unsigned threads,
                          unsigned ty, unsigned tz, unsigned shared, void* stream, void** arguments,
                          void** extra) {
  const Function& kernel = *static_cast<Function*>(function);
  if (current() != kernel.module->context) return kInvalidContext;
  if (!x || y * z * ty * tz != 1 || shared || stream || extra) return kInvalidValue;
  return run(kernel.name, x, threads, arguments[0]) ? kInvalidValue : 0;
}

EXPORT int cuGetProcAddress_v2(const char* name, void** to, int, uint64_t, int* found) {
  *to = dlsym(RTLD_DEFAULT, name);
  Dl_info here{}, there{};
  dladdr(reinterpret_cast<void*>(&cuInit), &here);
  if (!*to || !dladdr(*to, &there) || here.dli_fbase != there.dli_fbase) {
    void* self = dlopen(here.dli_fname, RTLD_NOW | RTLD_NOLOAD);
    *to = dlsym(self, name);
  }
  if (found) *found = *to ? 0 : 1;
  return *to ? 0 : kNotFound;
}
EXPORT int cuGetProcAddress(const char* name, void** to, int version, uint64_t flags) {
  return cuGetProcAddress_v2(name, to, version, flags, nullptr);
}
