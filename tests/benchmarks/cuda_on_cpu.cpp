// twin.cu for a CPU: its threads run one after the other.
#include <algorithm>
#include <cmath>

using std::copysign, std::exp2, std::fabs, std::isfinite, std::max, std::min, std::rint;
#define __device__
#define __forceinline__ inline
#define __global__
#define __launch_bounds__(...)
static struct { unsigned x; } blockIdx, threadIdx;

#include "twin.cu"

#define ON_CPU(name, T)                                                                           \
  extern "C" void name##_on_cpu(const T* columns, const long long* where, long long n,            \
                                long long first, long long last, T dt, int n_steps, T* reals,     \
                                int* mode_switches, unsigned char* finite) {                      \
    for (blockIdx.x = 0; first + blockIdx.x * (long long)BLOCK < last; ++blockIdx.x)              \
      for (threadIdx.x = 0; threadIdx.x < BLOCK; ++threadIdx.x)                                   \
        name(columns, where, n, first, last, dt, n_steps, reals, mode_switches, finite);          \
  }
ON_CPU(twin_float, float)
ON_CPU(twin_double, double)
