// The default model by hand for an NVIDIA GPU: twin.cpp with one scenario in each thread.
//
// The whole run is one launch, and state lives in registers. What differs from twin.cpp:
//  - where a thread turns, it changes what its torque is made of, so that no step selects that;
//  - in float, the exponential of eq. 1 is one instruction, cheaper than a branch around it;
//  - one branch leads to all metrics that change rarely. A warp of random scenarios takes it in 0.48
//    of its steps, and in 0.23 a scenario turns to converge;
//  - columns may be scalars.
// It includes no header, so that NVRTC compiles it as it is.

namespace {

typedef long long Index;

template <class T> struct Real;
template <> struct Real<float> {
  static constexpr float epsilon = 1.1920929e-07f;
  static constexpr bool always_bend = true;
  static constexpr int unroll = 2;  // plant steps: 3 % fewer instructions
};
template <> struct Real<double> {
  static constexpr double epsilon = 2.220446049250313e-16;
  static constexpr bool always_bend = false;
  static constexpr int unroll = 1;
};

// One instruction in float. In double fmin would look for NaN after the comparison. A NaN in b passes
// only in double; `finite` does not need it, since position and velocity remain NaN.
__device__ __forceinline__ float lesser(float a, float b) { return fminf(a, b); }
__device__ __forceinline__ float greater(float a, float b) { return fmaxf(a, b); }
__device__ __forceinline__ double lesser(double a, double b) { return a < b ? a : b; }
__device__ __forceinline__ double greater(double a, double b) { return a > b ? a : b; }

// 2^a: exp2f without its steps for denormal results, with the same 2 ulp (expf has 1 to 2).
__device__ __forceinline__ float power_of_2(float a) {
#ifdef __CUDA_ARCH__
  float power;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(power) : "f"(a));
  return power;
#else
  return exp2f(a);
#endif
}
__device__ __forceinline__ double power_of_2(double a) { return exp2(a); }

// a/b within 2 ulp for b that is no denormal, for which `/` would call a subroutine.
__device__ __forceinline__ float quotient(float a, float b) {
#ifdef __CUDA_ARCH__
  float per_b;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(per_b) : "f"(b));
  return a * per_b;
#else
  return a / b;
#endif
}
__device__ __forceinline__ double quotient(double a, double b) { return a / b; }

// ---- The law -------------------------------------------------------------------------------------

template <class T> struct Plant {
  T gap, Kenv, Denv;

  __device__ __forceinline__ T interaction(T x, T v) const {
    return x >= gap ? Kenv * (x - gap) + Denv * greater(T(0), v) : T(0);
  }
};

template <class T> struct Spring {
  T K0, Fmax, x0, xb, rate, dF;  // exp(-(y - x0)/b) = 2^(rate (y - x0))
};

template <class T> struct Held {  // what a step holds: torque (|e| > x0 ? far : near)(e - offset)
  T near, far, offset;
  T bent;  // rad, width of the bend of eq. 1 beyond x0; 0 while converging, which has none

  __device__ __forceinline__ bool diverging() const { return bent > 0; }

  __device__ __forceinline__ void diverge(const Spring<T>& s) {
    near = s.K0;
    far = 2 * s.Fmax / s.x0;  // the limit makes it +-Fmax
    offset = 0;
    bent = s.xb - s.x0;
  }

  // Both slopes of Algorithm 1 at the peak error e_M.
  __device__ __forceinline__ void converge(const Spring<T>& s, T e_M) {
    const T peak = fabs(e_M);
    near = far = 2 * s.K0;
    if (peak > s.x0) {
      const T per_peak = quotient(T(1), peak);
      const T decay = power_of_2(s.rate * (lesser(s.xb, peak) - s.x0));
      const T b = quotient(T(-1.4426950408889634), s.rate);
      const T energy = s.Fmax * (peak - s.x0) + s.K0 * s.x0 * s.x0 / 2 - b * s.dF * (1 - decay);
      near = 4 * energy * per_peak * per_peak;
      far = 2 * (peak < s.xb ? s.Fmax - s.dF * decay : s.Fmax) * per_peak;
    }
    offset = e_M / 2;
    bent = 0;
  }

  __device__ __forceinline__ T torque(const Spring<T>& s, T e) const {
    const T y = fabs(e) - s.x0, straight = (y > 0 ? far : near) * (e - offset);
    const bool bends = y > 0 && y < bent;
    T bend = 0;
    if (Real<T>::always_bend || bends) bend = copysign(s.Fmax - s.dF * power_of_2(s.rate * y), e);
    const T t = bends ? bend : straight;
    return greater(-s.Fmax, lesser(s.Fmax, t));
  }
};

template <class T> struct Sum {  // Kahan 1965
  T total = 0, excess = 0;

  __device__ __forceinline__ void add(T value) {
    const T term = value - excess, sum = total + term;
    excess = (sum - total) - term;
    total = sum;
  }
};

// ---- One scenario, from first to last step -------------------------------------------------------

enum Field { K0, Fmax, x0, xb, S, Td, xd, sigma, period, I, Kenv, Denv, gap, x_init, v_init };

template <class T>
__device__ __forceinline__ void run(const T* __restrict__ columns, const Index* __restrict__ where,
                                    Index n, Index i, T dt, int n_steps, T* __restrict__ reals,
                                    int* __restrict__ mode_switches,
                                    unsigned char* __restrict__ finite) {
  const T band = T(0.05);  // converged while |T/T_n - 1| is at most this
  auto load = [&](Field field) { return columns[where[2 * field] + where[2 * field + 1] * i]; };
  const Plant<T> plant = {load(gap), load(Kenv), load(Denv)};
  const T whole = dt / load(I), half = whole / 2, sixth = whole / 6;
  Spring<T> s = {load(K0), load(Fmax), load(x0), load(xb), 0, 0};
  s.rate = T(-1.4426950408889634) * load(S) / (s.xb - s.x0);
  s.dF = s.Fmax - s.K0 * s.x0;
  const T wanted = load(Td), search = load(sigma) / s.K0;
  const T xd_size = fabs(load(xd)), expected = load(xd) + wanted / s.K0;
  const T per_T_n = 1 / copysign(lesser(fabs(wanted), s.Fmax), wanted);
  const int ticks_every = max(int(rint(load(period) / dt)), 1);
  // A joint that moves by less in a plant step rests: its branch is the sign of rounding errors.
  const T rest = 4 * Real<T>::epsilon *
                 (fabs(expected) + fabs(load(gap)) + fabs(load(x_init)) + s.xb) *
                 (dt / load(period));

  T x = load(x_init), v = load(v_init), tau_env = plant.interaction(x, v), x_h = expected;
  T e_last = x_h - x, highest = tau_env;
  T apart = tau_env * per_T_n - 1, settled = 0;
  Held<T> held;
  held.diverge(s);
  T branch = -1;  // `bent` of the last step that moved the joint; -1 is none
  int switches = -1;
  int next_tick = 0;
  const int touched_at_start = x >= plant.gap;
  int before_touch = touched_at_start ? 0 : n_steps, touching_steps = 0;
  Sum<T> square, error, work;

  int k = 0;
  auto advance = [&](int end) {
#pragma unroll Real<T>::unroll
    for (; k < end; ++k) {
      // Algorithm 2
      const T e1 = tau_env - wanted;
      if (k == next_tick) {
        next_tick += ticks_every;
        x_h = fabs(x) <= xd_size && e1 != 0 ? expected : x_h - search * e1;
      }
      // Algorithm 1. The peak error is the last one before the joint turned.
      const T e = x_h - x;
      const bool diverging = e * v <= 0;
      if (diverging != held.diverging()) {
        if (diverging)
          held.diverge(s);
        else
          held.converge(s, e_last);
      }
      e_last = e;
      // RK4; x' = v, so that the stages of x need no sums of their own
      const T t1 = held.torque(s, e), f1 = t1 - tau_env;
      const T x2 = x + dt / 2 * v, v2 = v + half * f1, t2 = held.torque(s, x_h - x2);
      const T T2 = plant.interaction(x2, v2), f2 = t2 - T2, e2 = T2 - wanted;
      const T x3 = x2 + dt / 2 * half * f1, v3 = v + half * f2, t3 = held.torque(s, x_h - x3);
      const T T3 = plant.interaction(x3, v3), f3 = t3 - T3, e3 = T3 - wanted;
      const T x4 = x + dt * v + dt * half * f2, v4 = v + whole * f3, t4 = held.torque(s, x_h - x4);
      const T T4 = plant.interaction(x4, v4), f4 = t4 - T4, e4 = T4 - wanted;
      // The integrals are states of the same step; error and square are means over it.
      work.add(dt / 6 * (t1 * v + t4 * v4 + 2 * (t2 * v2 + t3 * v3)));
      error.add(T(1) / 6 * (e1 + e4 + 2 * (e2 + e3)));
      square.add(T(1) / 6 * (e1 * e1 + e4 * e4 + 2 * (e2 * e2 + e3 * e3)));
      const T way = dt * v + dt * sixth * (f1 + f2 + f3), x1 = x;
      x += way;
      v += sixth * (f1 + 2 * (f2 + f3) + f4);
      // Metrics of the end of the step
      tau_env = plant.interaction(x, v);
      const T last = apart;
      apart = tau_env * per_T_n - 1;
      highest = greater(tau_env, highest);
      const bool touching = x >= plant.gap, enters = fabs(apart) <= band && !(fabs(last) <= band);
      const bool touched = x1 >= plant.gap, switched = fabs(x - x1) > rest && branch != held.bent;
      if (enters | switched | (touching != touched)) {  // one branch for all that is rare
        if (enters)  // on a line between the two samples
          settled = k + quotient(last - copysign(band, last), last - apart);
        if (switched) {
          branch = held.bent;
          ++switches;
        }
        if (touching && !touched) {
          before_touch = min(before_touch, k);
          touching_steps -= k;
        }
        if (touched && !touching) touching_steps += k;
      }
    }
  };
  advance(n_steps / 2);
  const T square_head = square.total;
  square = error = {};
  advance(n_steps);

  const T per_square = per_T_n * per_T_n;
  const T nmse = (square_head + square.total) / n_steps * per_square;
  const int n_tail = n_steps - n_steps / 2;
  const int touch = before_touch + 1 - touched_at_start;  // the end of its step
  if (x >= plant.gap) touching_steps += n_steps;
  const int lost = n_steps - before_touch - touching_steps;
  const bool converged = fabs(apart) <= band && settled <= T(0.95) * n_steps;
  const T inf = exp2(T(1024));  // NVRTC knows no name for it
  const T values[] = {
      nmse,
      square.total / n_tail * per_square,
      converged ? settled * dt : inf,
      error.total / n_tail * per_T_n,
      highest,
      wanted > 0 ? greater(highest * per_T_n - 1, T(0)) : T(0),
      touch <= n_steps ? touch * dt : inf,
      touch <= n_steps && lost > 0 ? lost * dt : T(0),
      work.total,
  };
  for (int m = 0; m < int(sizeof(values) / sizeof(T)); ++m) reals[m * n + i] = values[m];
  mode_switches[i] = max(switches, 0);
  finite[i] = isfinite(x) && isfinite(v) && isfinite(nmse) && isfinite(work.total);
}

}  // namespace

#ifndef BLOCK
#define BLOCK 128  // threads
#endif

// Scenarios first..last - 1 of n. Field f of scenario i is columns[where[2 f] + where[2 f + 1] i];
// reals is [metric][n]. A multiprocessor shall hold at least `threads` threads: more would
// spill registers (a thread takes 72 to 79 in float, 144 to 146 in double).
#define RUN(name, T, threads)                                                                     \
  extern "C" __global__ void __launch_bounds__(BLOCK, threads / BLOCK)                            \
      name(const T* columns, const long long* where, long long n, long long first,                \
           long long last, T dt, int n_steps, T* reals, int* mode_switches,                       \
           unsigned char* finite) {                                                               \
    const Index i = first + Index(blockIdx.x) * BLOCK + threadIdx.x;                              \
    if (i < last) run(columns, where, n, i, dt, n_steps, reals, mode_switches, finite);           \
  }
RUN(twin_float, float, 896)
RUN(twin_double, double, 384)
