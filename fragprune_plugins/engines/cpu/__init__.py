"""The CPU engine: compiled C++ behind a plain C interface, opened with ctypes."""
