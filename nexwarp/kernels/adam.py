"""One step of Adam (Kingma and Ba, 2015) on many parameters, with a hash grid's regulariser and half-precision copy.

A thread is four neighbouring values of one parameter, on a CPU 1,024, written in place with their moments. The
regulariser is sum_l c_l sum(H_l^2) over the levels of a grid (L, T, F): its gradient is added to what autograd gave.
Its value, before the step, is written as one sum for each warp, on a CPU for each thread. Neither depends on the order
of threads.
"""

import warp as wp

from nexwarp.native import snippet
from nexwarp.native.warp import lane_index, warp_size, warp_sum

VALUES, CPU_VALUES = 4, 1024  # of a thread
MOST = 16  # parameters of a launch

Real = wp.array(dtype=wp.float32)
Addresses = wp.types.vector(length=MOST, dtype=wp.uint64)
Numbers = wp.types.vector(length=MOST, dtype=wp.int32)


@wp.struct
class Adam:
    """Parameters of flat float32 values, on CUDA from addresses that are multiples of 16; a grid is the first one."""

    starts: Numbers  # first thread of each; beyond all threads where there is no parameter
    counts: Numbers  # of values
    values: Addresses
    means: Addresses
    squares: Addresses
    grads: Addresses  # 0 where they are zero
    steps: Addresses
    rates: Addresses
    halves: wp.array(dtype=wp.float16)  # of the grid; empty where there is no copy
    factors: Real  # c_l, empty without a regulariser; level l begins at value l << level_bits
    level_bits: wp.int32
    beta1: wp.float32
    beta2: wp.float32
    rest1: wp.float32  # 1 - beta1
    rest2: wp.float32
    log_beta1: wp.float32
    log_beta2: wp.float32
    epsilon: wp.float32


_LISTS = [name for name, field in Adam.vars.items() if field.type in (Numbers, Addresses)]
_OF_ALL = "".join(f"    const auto {name} = adam.{name};\n" for name in Adam.vars if name not in _LISTS)
# The parameter of a thread is the last one that begins before it.
_OF_ONE = f"""
    int chosen = 0;
    for (int k = 1; k < {MOST}; ++k) chosen += thread >= adam.starts.c[k];
""" + "".join(f"    const auto {name} = adam.{name}.c[chosen];\n" for name in _LISTS)
# `rest` is 1 - beta^step, which is small in the first steps: in double precision, or by the function made for that.
_CUDA = """
    constexpr int WIDE = VALUES;
    const unsigned first = VALUES * (unsigned)(thread - starts), end = first + VALUES;
    auto copy = [](wp::float32* to, const wp::float32* from) {
        *reinterpret_cast<float4*>(to) = *reinterpret_cast<const float4*>(from);
    };
    auto root = [](wp::float32 x) { return sqrtf(x); };
    auto rest = [](wp::float32 log_beta, wp::float32 step) { return -expm1f(log_beta * step); };
"""
# Blocks of 16 in loops of known length become vector instructions.
_CPU = """
    constexpr int WIDE = 16;
    const unsigned first = CPU_VALUES * (unsigned)(thread - starts), end = first + CPU_VALUES;
    auto copy = [](wp::float32* to, const wp::float32* from) { __builtin_memcpy(to, from, sizeof(float[WIDE])); };
    auto root = [](wp::float32 x) { return __builtin_elementwise_sqrt(x); };
    auto rest = [](wp::float32 log_beta, wp::float32 step) { return (float)(1.0 - wp::exp((double)log_beta * step)); };
"""
_STEP = """
    auto number = [](wp::uint64 address) { return *reinterpret_cast<const wp::float32*>(address); };
    const wp::float32 step = number(steps), rate = number(rates) / rest(log_beta1, step);
    const wp::float32 correction = 1.0f / root(rest(log_beta2, step));
    const bool grid = starts == 0, regularised = grid && factors.shape[0] > 0;
    const unsigned count = counts;
    wp::float32 losses[WIDE] = {};
    for (unsigned at = first; at < end && at < count; at += WIDE) {
        const int size = at + WIDE <= count ? WIDE : (int)(count - at);
        auto read = [&](wp::uint64 address, wp::float32* to) {
            const auto from = reinterpret_cast<const wp::float32*>(address) + at;
            if (size == WIDE) copy(to, from);
            else for (int k = 0; k < WIDE; ++k) to[k] = k < size ? from[k] : 0.0f;
        };
        auto write = [&](wp::uint64 address, const wp::float32* from) {
            const auto to = reinterpret_cast<wp::float32*>(address) + at;
            if (size == WIDE) copy(to, from);
            else for (int k = 0; k < WIDE; ++k) if (k < size) to[k] = from[k];
        };
        alignas(16) wp::float32 p[WIDE], g[WIDE] = {}, m[WIDE], v[WIDE];
        read(values, p);
        read(means, m);
        read(squares, v);
        if (grads) read(grads, g);
        if (regularised) {
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
        if (grid && halves.shape[0] > 0) {
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


_TEXT = snippet(_CUDA + _STEP.replace("HALVES", _HALVES), _CPU + _STEP.replace("HALVES", _CPU_HALVES))
_TEXT = _OF_ALL + _OF_ONE + _TEXT.replace("CPU_VALUES", str(CPU_VALUES)).replace("VALUES", str(VALUES))


@wp.func_native(_TEXT)
def update(thread: wp.int32, adam: Adam) -> wp.float32:
    """Step a thread's values; return their share of the regulariser."""
    ...


@wp.kernel(enable_backward=False, module="unique", launch_bounds=(256, 5))
def adam_step(first: int, adam: Adam, losses: Real):
    """Losses are those of the grid's warps."""
    thread = first + wp.tid()
    loss = update(thread, adam)
    warp = thread // warp_size()
    if warp < losses.shape[0]:
        loss = warp_sum(loss)
        if lane_index() == 0:
            losses[warp] = loss
