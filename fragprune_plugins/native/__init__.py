"""The compiled rasterizer: plain shared libraries behind a C interface, opened with ctypes."""
