// The default model by hand: what this machine can do when nothing stands between the law and it.
//
// One vector of scenarios runs its whole time loop before the next one begins, so state lives in
// registers and the first-level cache. More vectors in flight were measured and were slower in the
// median: their state spills. What a branch-free program cannot do, and this does:
//  - the exponential of eq. 1 only in a stage in which a lane needs it: it diverges between x0 and xb
//    (one stage of eight lanes in twelve);
//  - the slopes of Algorithm 1 only when a lane turns to converge;
//  - the instant at which the torque enters the settling band only when a lane enters it;
//  - the overshoot from the peak, since a hard stop never pulls.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <thread>
#include <vector>
#if defined(__AVX__) && !defined(__AVX512F__)
#include <immintrin.h>
#endif

namespace {

// ---- Vectors -------------------------------------------------------------------------------------

#if defined(__AVX512F__)
constexpr int kBytes = 64;
#elif defined(__AVX__)
constexpr int kBytes = 32;
#else
constexpr int kBytes = 16;  // SSE2, NEON
#endif

typedef float Floats __attribute__((vector_size(kBytes)));
typedef double Doubles __attribute__((vector_size(kBytes)));
typedef int32_t Ints __attribute__((vector_size(kBytes)));  // a comparison gives -1 where true
typedef int64_t Longs __attribute__((vector_size(kBytes)));

template <class V> struct Real;
template <> struct Real<Floats> {
  using T = float;
  using Int = int32_t;
  using Mask = Ints;
  static constexpr int mantissa = 23;
  static constexpr T round = 12582912.0f;  // 1.5 * 2^mantissa: adding it rounds to an integer
  static constexpr T least_exponent = -126;
  // 2^f on -1/2..1/2, interpolated at Chebyshev nodes: 1.8 ulp
  static constexpr T poly[] = {1.0f,          0.693147188f,   0.240221075f,
                               0.0555035711f, 0.00967603192f, 0.00133908634f};
};
template <> struct Real<Doubles> {
  using T = double;
  using Int = int64_t;
  using Mask = Longs;
  static constexpr int mantissa = 52;
  static constexpr T round = 6755399441055744.0;
  static constexpr T least_exponent = -1022;
  static constexpr T poly[] = {1.0,
                               0.69314718055994529,
                               0.24022650695910158,
                               0.055504108664821625,
                               0.0096181291075872564,
                               0.0013333558146406471,
                               0.00015403530463724353,
                               1.5252733841556773e-05,
                               1.3215432535912375e-06,
                               1.0178057087733941e-07,
                               7.0741942972885211e-09,
                               4.4558179083360645e-10};
};
template <class V> using Mask = typename Real<V>::Mask;

#define INLINE inline __attribute__((always_inline))

// Only the sign of the mask is read, as a blend instruction does.
template <class V, class M> INLINE V select(M mask, V a, V b) { return mask < 0 ? a : b; }

// a < b ? a : b, and a > b ? a : b: a NaN in b passes, one in a does not. One instruction each, which
// the compiler does not find behind the portable form.
#if defined(__AVX__) && !defined(__AVX512F__)
INLINE Floats lesser(Floats a, Floats b) { return _mm256_min_ps(a, b); }
INLINE Floats greater(Floats a, Floats b) { return _mm256_max_ps(a, b); }
INLINE Doubles lesser(Doubles a, Doubles b) { return _mm256_min_pd(a, b); }
INLINE Doubles greater(Doubles a, Doubles b) { return _mm256_max_pd(a, b); }
#else
template <class V> INLINE V lesser(V a, V b) { return a < b ? a : b; }
template <class V> INLINE V greater(V a, V b) { return a > b ? a : b; }
#endif

template <class M> INLINE bool any(M mask) {
#if defined(__AVX__) && !defined(__AVX512F__)
  return !_mm256_testz_si256((__m256i)mask, (__m256i)mask);
#else
  uint64_t words[kBytes / 8], all = 0;
  std::memcpy(words, &mask, kBytes);
  for (uint64_t word : words) all |= word;
  return all != 0;
#endif
}
template <class V> INLINE V abs(V a) {
  return (V)((Mask<V>)a & std::numeric_limits<typename Real<V>::Int>::max());
}
template <class V> INLINE V with_sign_of(V s, V a) {
  return (V)((Mask<V>)a ^ ((Mask<V>)s & std::numeric_limits<typename Real<V>::Int>::min()));
}
// 2^(y rate) for y rate <= 0; elsewhere garbage that no caller keeps.
template <class V> INLINE V exp2(V y, V rate) {
  using R = Real<V>;
  constexpr int n = sizeof(R::poly) / sizeof(R::poly[0]);
  const V limited = greater(V{} + R::least_exponent, y * rate);  // a sharper spring: as good as zero
  const V shifted = limited + R::round, f = limited - (shifted - R::round), f2 = f * f;
  V p = R::poly[n - 1] * f + R::poly[n - 2];
#pragma GCC unroll 16  // in pairs: half the latency of Horner's rule
  for (int i = n - 4; i >= 0; i -= 2) p = p * f2 + (R::poly[i + 1] * f + R::poly[i]);
  return (V)((Mask<V>)p + ((Mask<V>)shifted << R::mantissa));
}

// ---- The law -------------------------------------------------------------------------------------

template <class V> struct Plant {
  V gap, Kenv, Denv;

  INLINE V interaction(V x, V v) const {
    const V pressed = Kenv * (x - gap) + Denv * greater(V{}, v);
    return (V)((x >= gap) & (Mask<V>)pressed);
  }
};

template <class V> struct Spring {
  V K0, Fmax, x0, xb, b, rate, dF;  // exp(-y/b) = 2^(rate y)

  // Both slopes of Algorithm 1 at the peak error e_M.
  INLINE void slopes(V e_M, V& near, V& far) const {
    const V peak = greater(x0, abs(e_M)), per_peak = 1 / peak;
    const V decay = exp2(lesser(xb, peak) - x0, rate);
    const V energy = Fmax * (peak - x0) + K0 * x0 * x0 / 2 - b * dF * (1 - decay);
    const V force = select(peak < xb, Fmax - dF * decay, Fmax);
    near = select(peak <= x0, 2 * K0, 4 * energy * per_peak * per_peak);
    far = select(peak <= x0, 2 * K0, 2 * force * per_peak);
  }
};

template <class V> struct Held {  // what a step holds: torque (|e| > x0 ? far : near)(e - offset)
  V x_h, near, far, offset;
  Mask<V> diverging;

  INLINE V torque(const Spring<V>& s, V x) const {
    const V e = x_h - x, size = abs(e);
    const Mask<V> beyond = size > s.x0, curved = diverging & beyond & (size < s.xb);
    V t = select(beyond, far, near) * (e - offset);
    if (any(curved))
      t = select(curved, with_sign_of(e, s.Fmax - s.dF * exp2(size - s.x0, s.rate)), t);
    return greater(-s.Fmax, lesser(s.Fmax, t));
  }
};

template <class V> struct Sum {  // Kahan 1965
  V total{}, excess{};

  INLINE void add(V value) {
    const V term = value - excess, sum = total + term;
    excess = (sum - total) - term;
    total = sum;
  }
};

// ---- One vector of scenarios, from first to last step ----------------------------------------------

enum Field { K0, Fmax, x0, xb, S, Td, xd, sigma, period, I, Kenv, Denv, gap, x_init, v_init };
constexpr int kReals = 9;  // metrics that are real numbers
constexpr double kBand = 0.05;         // converged while |T/T_n - 1| is at most this
constexpr double kLatest = 1.0 - 0.05;  // part of the run at which a torque may converge last

template <class T> struct Job {
  const T* columns;  // [field][n]
  int64_t n;
  T dt;
  int n_steps;
  T* reals;  // [metric][n]
  int32_t* switches;
  uint8_t* finite;
};

template <class V, class T> void run_vector(const Job<T>& job, int64_t first) {
  using M = Mask<V>;
  using Int = typename Real<V>::Int;
  constexpr int lanes = kBytes / sizeof(T);
  const T dt = job.dt;
  auto load = [&](Field field) {  // the lanes left over repeat the last scenario
    V r;
    for (int w = 0; w < lanes; ++w)
      r[w] = job.columns[field * job.n + std::min(first + w, job.n - 1)];
    return r;
  };
  const Plant<V> plant = {load(gap), load(Kenv), load(Denv)};
  const V whole = dt / load(I), half = whole / 2, sixth = whole / 6;
  Spring<V> spring = {load(K0), load(Fmax), load(x0), load(xb), V{}, V{}, V{}};
  spring.b = (spring.xb - spring.x0) / load(S);
  spring.rate = T(-1.4426950408889634) / spring.b;
  spring.dF = spring.Fmax - spring.K0 * spring.x0;
  const V saturating = 2 * spring.Fmax / spring.x0;  // beyond x0 the limit makes it +-Fmax
  const V wanted = load(Td), search = load(sigma) / spring.K0;
  const V xd_size = abs(load(xd)), expected = load(xd) + wanted / spring.K0;
  const V T_n = with_sign_of(wanted, lesser(abs(wanted), spring.Fmax)), per_T_n = 1 / T_n;
  const V span = load(period) / dt;
  M ticks_every;
  for (int w = 0; w < lanes; ++w) ticks_every[w] = std::max(Int(std::nearbyint(span[w])), Int(1));
  // A joint that moves by less in a plant step rests: its branch is the sign of rounding errors.
  const V rest = 4 * std::numeric_limits<T>::epsilon() *
                 (abs(expected) + abs(load(gap)) + abs(load(x_init)) + spring.xb) *
                 (dt / load(period));
  const V never = V{} + std::numeric_limits<T>::infinity();

  V x = load(x_init), v = load(v_init), tau_env = plant.interaction(x, v), x_h = expected;
  V e_M = x_h - x, near{}, far{}, highest = tau_env, square_head{};
  V apart = tau_env * per_T_n - 1, settled = select(abs(apart) <= T(kBand), V{}, never);
  M countdown{}, diverging = M{} - 1;  // so that a first branch that converges computes its slopes
  M branch = M{} + 1, switches = M{} - 1;  // the first branch differs from 1, which is none
  M before_touch{}, touching_steps{};
  const M touched_at_start = x >= plant.gap;
  M untouched = ~touched_at_start;
  Sum<V> square, error, work;

  const int ends[] = {job.n_steps / 2, job.n_steps};
  for (int part = 0, k = 0; part < 2; ++part) {
    if (part == 1) {
      square_head = square.total;
      square = error = {};
    }
    for (; k < ends[part]; ++k) {
      // Algorithm 2
      const M ticks = countdown <= 0;
      const V e1 = tau_env - wanted;
      const V target = select(abs(x) <= xd_size, expected, x_h - search * e1);
      x_h = select(ticks & (e1 != 0), target, x_h);
      countdown = select(ticks, ticks_every, countdown) - 1;
      // Algorithm 1
      const V e = x_h - x;
      const M before = diverging;
      diverging = e * v <= 0;
      if (any(before & ~diverging)) spring.slopes(e_M, near, far);
      e_M = select(diverging, e, e_M);
      const Held<V> held = {x_h, select(diverging, spring.K0, near),
                            select(diverging, saturating, far), select(diverging, V{}, e_M / 2),
                            diverging};
      // RK4; x' = v, so that the stages of x need no sums of their own
      // the net torques are divided by I only where they move something: off the stages' chain
      const V t1 = held.torque(spring, x), f1 = t1 - tau_env;
      const V x2 = x + dt / 2 * v, v2 = v + half * f1, t2 = held.torque(spring, x2);
      const V T2 = plant.interaction(x2, v2), f2 = t2 - T2, e2 = T2 - wanted;
      const V x3 = x2 + dt / 2 * half * f1, v3 = v + half * f2, t3 = held.torque(spring, x3);
      const V T3 = plant.interaction(x3, v3), f3 = t3 - T3, e3 = T3 - wanted;
      const V x4 = x + dt * v + dt * half * f2, v4 = v + whole * f3, t4 = held.torque(spring, x4);
      const V T4 = plant.interaction(x4, v4), f4 = t4 - T4, e4 = T4 - wanted;
      // The integrals are states of the same step; error and square are means over it.
      work.add(dt / 6 * (t1 * v + t4 * v4 + 2 * (t2 * v2 + t3 * v3)));
      error.add(T(1) / 6 * (e1 + e4 + 2 * (e2 + e3)));
      square.add(T(1) / 6 * (e1 * e1 + e4 * e4 + 2 * (e2 * e2 + e3 * e3)));
      const V way = dt * v + dt * sixth * (f1 + f2 + f3), x1 = x;
      x += way;
      v += sixth * (f1 + 2 * (f2 + f3) + f4);
      // Metrics of the end of the step
      tau_env = plant.interaction(x, v);
      const V last = apart;
      apart = tau_env * per_T_n - 1;
      const M inside = abs(apart) <= T(kBand), enters = inside & (settled == never);
      if (any(enters)) {  // on a line between the two samples
        const V rise = select(last == apart, V{} + 1, last - apart);
        settled = select(enters, T(k) + (last - with_sign_of(last, V{} + T(kBand))) / rise, settled);
      }
      settled = select(inside, settled, never);
      highest = greater(tau_env, highest);
      const M touching = x >= plant.gap;
      touching_steps -= touching;
      untouched &= ~touching;
      before_touch -= untouched;
      const M current = select(abs(x - x1) > rest, diverging, branch);
      switches -= current != branch;
      branch = current;
    }
  }

  const int n = job.n_steps, n_tail = n - n / 2;
  constexpr T inf = std::numeric_limits<T>::infinity();
  const V per_square = per_T_n * per_T_n;
  for (int w = 0; w < lanes && first + w < job.n; ++w) {
    const T nmse = (square_head[w] + square.total[w]) / n * per_square[w];
    const Int touch = before_touch[w] + (touched_at_start[w] ? 0 : 1);  // the end of its step
    const Int lost = n - touch - touching_steps[w];
    const T reals[kReals] = {
        nmse,
        square.total[w] / n_tail * per_square[w],
        settled[w] <= T(kLatest * n) ? settled[w] * dt : inf,
        error.total[w] / n_tail * per_T_n[w],
        highest[w],
        T_n[w] > 0 ? std::max(highest[w] * per_T_n[w] - 1, T(0)) : T(0),
        touch <= n ? T(touch) * dt : inf,
        touch <= n && lost > 0 ? T(lost) * dt : T(0),
        work.total[w],
    };
    for (int m = 0; m < kReals; ++m) job.reals[m * job.n + first + w] = reals[m];
    job.switches[first + w] = int32_t(std::max(switches[w], Int(0)));
    job.finite[first + w] = std::isfinite(x[w]) && std::isfinite(v[w]) && std::isfinite(nmse) &&
                            std::isfinite(work.total[w]);
  }
}

template <class V, class T> void run(const Job<T>& job, int threads) {
  constexpr int64_t lanes = kBytes / sizeof(T);
  const int64_t vectors = (job.n + lanes - 1) / lanes;
  auto share = [&](int64_t t) {
    for (int64_t i = vectors * t / threads; i < vectors * (t + 1) / threads; ++i)
      run_vector<V>(job, i * lanes);
  };
  std::vector<std::thread> others;
  for (int t = 1; t < threads; ++t) others.emplace_back(share, t);
  share(0);
  for (auto& other : others) other.join();
}

}  // namespace

#define RUN(name, V, T)                                                                        \
  extern "C" void name(const T* columns, int64_t n, T dt, int n_steps, int threads, T* reals,  \
                       int32_t* switches, uint8_t* finite) {                                   \
    run<V>(Job<T>{columns, n, dt, n_steps, reals, switches, finite}, threads);                 \
  }
RUN(run_float, Floats, float)
RUN(run_double, Doubles, double)
