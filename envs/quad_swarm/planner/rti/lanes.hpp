// Arithmetic on lanes: a vector of W numbers, lane q of every vector belonging to problem q of the batch.
//
// Plain +, -, *, / on GCC/Clang vectors are IEEE operations lane by lane. Multiplications and additions are fused only
// where the source says so (compiled with -ffp-contract=off), so a lane's result depends neither on its neighbours nor
// on the width W, nor on what the compiler inlines.
#pragma once
#include <cmath>
#include <cstdint>
#include <initializer_list>
#include <utility>
#include <type_traits>
#if defined(__x86_64__) && defined(__FMA__)
#include <immintrin.h>
#define LANES_X86 1
#endif
#if defined(__has_builtin)
#if __has_builtin(__builtin_elementwise_fma)
#define LANES_ELEMENTWISE_FMA 1
#endif
#endif

#if defined(LANES_VECTOR_BYTES)  // for tests: results do not depend on it
constexpr int VECTOR_BYTES = LANES_VECTOR_BYTES;
#elif defined(__AVX512F__)
constexpr int VECTOR_BYTES = 64;
#elif defined(__AVX__)
constexpr int VECTOR_BYTES = 32;
#else
constexpr int VECTOR_BYTES = 16;
#endif
constexpr int NARROW_VECTOR_BYTES = VECTOR_BYTES > 16 ? VECTOR_BYTES / 2 : 16;  // for few problems

template <class T, int W>
struct LaneTypes {
  using Integer = std::conditional_t<sizeof(T) == 4, std::int32_t, std::int64_t>;
  typedef T Real __attribute__((vector_size(W * sizeof(T))));
  typedef Integer Mask __attribute__((vector_size(W * sizeof(T))));
};

template <class V>
using Element = std::decay_t<decltype(std::declval<V>()[0])>;

template <class V>
constexpr int WIDTH = sizeof(V) / sizeof(Element<V>);

template <class V>
using MaskOf = typename LaneTypes<Element<V>, WIDTH<V>>::Mask;

template <class V>
inline V splat(double value) {
  return V{} + static_cast<Element<V>>(value);
}

template <class V>
inline V select(MaskOf<V> mask, V a, V b) {
  return mask ? a : b;
}

template <class V>
inline V maximum(V a, V b) {
  return a > b ? a : b;
}

template <class V>
inline V minimum(V a, V b) {
  return a < b ? a : b;
}

template <class M>
inline bool any(M mask) {
  bool result = false;
  for (int q = 0; q < WIDTH<M>; q++) result |= mask[q] != 0;
  return result;
}

#if defined(LANES_X86)
#define LANES_DISPATCH(OPERATION, ...)                                          \
  constexpr bool single = sizeof(Element<V>) == 4;                              \
  if constexpr (sizeof(V) == 16 && single) return V(_mm_##OPERATION##_ps(__VA_ARGS__));     \
  if constexpr (sizeof(V) == 16 && !single) return V(_mm_##OPERATION##_pd(__VA_ARGS__));    \
  if constexpr (sizeof(V) == 32 && single) return V(_mm256_##OPERATION##_ps(__VA_ARGS__));  \
  if constexpr (sizeof(V) == 32 && !single) return V(_mm256_##OPERATION##_pd(__VA_ARGS__)); \
  LANES_DISPATCH_512(OPERATION, __VA_ARGS__)
#if defined(__AVX512F__)
#define LANES_DISPATCH_512(OPERATION, ...)                                                  \
  if constexpr (sizeof(V) == 64 && single) return V(_mm512_##OPERATION##_ps(__VA_ARGS__));  \
  if constexpr (sizeof(V) == 64 && !single) return V(_mm512_##OPERATION##_pd(__VA_ARGS__));
#else
#define LANES_DISPATCH_512(OPERATION, ...)
#endif
#endif

// a b + c, rounded once where the processor can.
template <class V>
inline V multiply_add(V a, V b, V c) {
#if defined(LANES_X86)
  LANES_DISPATCH(fmadd, a, b, c)
#elif defined(LANES_ELEMENTWISE_FMA)
  return __builtin_elementwise_fma(a, b, c);
#else
  return a * b + c;
#endif
}

// c - a b
template <class V>
inline V negative_multiply_add(V a, V b, V c) {
#if defined(LANES_X86)
  LANES_DISPATCH(fnmadd, a, b, c)
#else
  return multiply_add(-a, b, c);
#endif
}

// a b - c
template <class V>
inline V multiply_subtract(V a, V b, V c) {
#if defined(LANES_X86)
  LANES_DISPATCH(fmsub, a, b, c)
#else
  return multiply_add(a, b, -c);
#endif
}

template <class V>
inline V square_root(V a) {
#if defined(LANES_X86)
  LANES_DISPATCH(sqrt, a)
#else
  for (int q = 0; q < WIDTH<V>; q++) a[q] = std::sqrt(a[q]);
  return a;
#endif
}

// tan(a): the [5/6] Pade approximant. Relative error below 2e-9 for |a| < 1 rad and 3e-12 for |a| < 0.6 rad.
template <class V>
inline V tangent(V a) {
  const V s = a * a;
  const V numerator = multiply_add(multiply_add(splat<V>(21), s, splat<V>(-1260)), s, splat<V>(10395));
  const V denominator = multiply_add(
      multiply_add(multiply_subtract(splat<V>(210), splat<V>(1), s), s, splat<V>(-4725)), s, splat<V>(10395));
  return a * numerator / denominator;
}

// cos(a): the Taylor polynomial of degree 14. Relative error below 1e-12 for |a| < 1 rad.
template <class V>
inline V cosine(V a) {
  const V s = a * a;
  V sum = splat<V>(-1.0 / 87178291200.0);
  for (double coefficient : {1.0 / 479001600.0, -1.0 / 3628800.0, 1.0 / 40320.0, -1.0 / 720.0, 1.0 / 24.0, -0.5, 1.0})
    sum = multiply_add(sum, s, splat<V>(coefficient));
  return sum;
}

// exp(a) to the last few bits. It saturates at |a| = 40, where the square of the result still fits single precision.
template <class V>
inline V exponential(V a) {
  using T = Element<V>;
  constexpr bool single = sizeof(T) == 4;
  const V limit = splat<V>(40);
  a = select<V>(a > limit, limit, a);  // written so that NaN stays NaN
  a = select<V>(a < -limit, -limit, a);
  // a = n log(2) + r with |r| <= log(2) / 2; adding `round` leaves n in the lowest bits.
  const V round = splat<V>(single ? 12582912.0 : 6755399441055744.0);
  const V shifted = multiply_add(a, splat<V>(1.4426950408889634), round);
  const V n = shifted - round;
  const V high = splat<V>(single ? 0.693359375 : 0.693147180369123816490);
  const V low = splat<V>(single ? -2.12194440e-4 : 1.90821492927058770002e-10);
  const V r = negative_multiply_add(n, low, negative_multiply_add(n, high, a));
  constexpr int degree = single ? 7 : 13;  // Taylor: the first term left out is below half a unit in the last place
  double factorial = 1;
  for (int k = 2; k <= degree; k++) factorial *= k;
  V sum = splat<V>(1 / factorial);
  for (int k = degree; k > 0; k--) {
    factorial /= k;
    sum = multiply_add(sum, r, splat<V>(1 / factorial));
  }
  using Bits = MaskOf<V>;
  const Bits exponent = ((Bits)shifted - (Bits)round) << (single ? 23 : 52);
  return (V)((Bits)sum + exponent);
}
