"""One step of Adam (Kingma and Ba, 2015), with the hash grid's regulariser and its half-precision copy.

A thread is four neighbouring values of one parameter, on a CPU 1,024, written in place with their moments. The
regulariser is sum_l c_l sum(H_l^2) over the levels of a grid (L, T, F): its gradient is added to what autograd gave.
Its value, before the step, is written as one sum for each warp, on a CPU for each thread. Neither depends on the order
of threads.
"""

import warp as wp

from nexwarp.native import snippet
from nexwarp.native.warp import lane_index, warp_size, warp_sum

VALUES, CPU_VALUES = 4, 1024  # of a thread

Real = wp.array(dtype=wp.float32)


@wp.struct
class Adam:
    """A parameter of flat values, on CUDA from addresses that are multiples of 16, and its step."""

    values: Real
    means: Real
    squares: Real
    grads: Real  # empty where they are zero
    halves: wp.array(dtype=wp.float16)  # empty where there is no copy
    factors: Real  # c_l, empty without a regulariser; level l begins at value l << level_bits
    level_bits: wp.int32
    step: Real
    rates: Real
    beta1: wp.float32
    beta2: wp.float32
    rest1: wp.float32  # 1 - beta1
    rest2: wp.float32
    log_beta1: wp.float32
    log_beta2: wp.float32
    epsilon: wp.float32


FIELDS = "".join(f"    const auto {name} = adam.{name};\n" for name in Adam.vars)

_CUDA = """
    constexpr int WIDE = VALUES;
    const size_t first = VALUES * (size_t)thread, end = first + VALUES;
    auto copy = [](wp::float32* to, const wp::float32* from) {
        *reinterpret_cast<float4*>(to) = *reinterpret_cast<const float4*>(from);
    };
    auto root = [](wp::float32 x) { return sqrtf(x); };
"""
# Blocks of 16 in loops of known length become vector instructions.
_CPU = """
    constexpr int WIDE = 16;
    const size_t first = CPU_VALUES * (size_t)thread, end = first + CPU_VALUES;
    auto copy = [](wp::float32* to, const wp::float32* from) { __builtin_memcpy(to, from, sizeof(float[WIDE])); };
    auto root = [](wp::float32 x) { return __builtin_elementwise_sqrt(x); };
"""
_STEP = """
    const size_t count = values.shape[0];
    wp::float32 losses[WIDE] = {};
    for (size_t at = first; at < end && at < count; at += WIDE) {
        const int size = at + WIDE <= count ? WIDE : (int)(count - at);
        auto read = [&](const wp::array_t<wp::float32>& from, wp::float32* to) {
            if (size == WIDE) copy(to, from.data + at);
            else for (int k = 0; k < WIDE; ++k) to[k] = k < size ? from.data[at + k] : 0.0f;
        };
        auto write = [&](const wp::array_t<wp::float32>& to, const wp::float32* from) {
            if (size == WIDE) copy(to.data + at, from);
            else for (int k = 0; k < WIDE; ++k) if (k < size) to.data[at + k] = from[k];
        };
        alignas(16) wp::float32 p[WIDE], g[WIDE] = {}, m[WIDE], v[WIDE];
        read(values, p);
        read(means, m);
        read(squares, v);
        if (grads.shape[0] > 0) read(grads, g);
        if (factors.shape[0] > 0) {
            for (int k = 0; k < WIDE; ++k) {
                const wp::float32 pull = k < size ? factors.data[(at + k) >> level_bits] * p[k] : 0.0f;
                g[k] += 2.0f * pull;
                losses[k] += pull * p[k];
            }
        }
        for (int k = 0; k < WIDE; ++k) {
            m[k] = beta1 * m[k] + rest1 * g[k];
            v[k] = beta2 * v[k] + rest2 * g[k] * g[k];
            p[k] -= rate * m[k] / (root(v[k]) * correction + epsilon);
        }
        write(values, p);
        write(means, m);
        write(squares, v);
        if (halves.shape[0] > 0) {
            HALVES
        }
    }
    wp::float32 loss = 0.0f;
    for (int k = 0; k < WIDE; ++k) loss += losses[k];
    return loss;
"""
_HALVES = """
            unsigned words[2];
            for (int k = 0; k < 2; ++k)
                asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(words[k]) : "f"(p[2 * k + 1]), "f"(p[2 * k]));
            if (size == WIDE) *reinterpret_cast<uint2*>(halves.data + at) = make_uint2(words[0], words[1]);
            else for (int k = 0; k < WIDE; ++k) if (k < size) halves.data[at + k] = wp::half(p[k]);
"""
_CPU_HALVES = "for (int k = 0; k < size; ++k) halves.data[at + k] = wp::half(p[k]);"


_TEXT = FIELDS + snippet(_CUDA + _STEP.replace("HALVES", _HALVES), _CPU + _STEP.replace("HALVES", _CPU_HALVES))
_TEXT = _TEXT.replace("CPU_VALUES", str(CPU_VALUES)).replace("VALUES", str(VALUES))


# 1 - beta^count, which is small in the first steps: in double precision, or by the function made for that.
@wp.func_native(
    snippet("return -expm1f(log_beta * count);", "return (float)(1.0 - wp::exp((double)log_beta * count));")
)
def rest_of_power(log_beta: wp.float32, count: wp.float32) -> wp.float32:
    """Return 1 - exp(log_beta * count)."""
    ...


@wp.func_native(_TEXT)
def update(thread: wp.int32, adam: Adam, rate: wp.float32, correction: wp.float32) -> wp.float32:
    """Step a thread's values; return their share of the regulariser."""
    ...


@wp.kernel(enable_backward=False, module="unique", launch_bounds=(256, 5))
def adam_step(first: wp.int32, adam: Adam, losses: Real):
    thread = first + wp.tid()
    rate = adam.rates[0] / rest_of_power(adam.log_beta1, adam.step[0])
    correction = 1.0 / wp.sqrt(rest_of_power(adam.log_beta2, adam.step[0]))
    loss = update(thread, adam, rate, correction)
    if losses.shape[0] > 0:
        loss = warp_sum(loss)
        if lane_index() == 0:
            losses[thread // warp_size()] = loss
