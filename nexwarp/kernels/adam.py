"""One step of Adam (Kingma and Ba, 2015), with the hash grid's regulariser and its half-precision copy.

A thread is four neighbouring values of one parameter, on a CPU 1,024, written in place with their moments. The
regulariser is sum_l c_l sum(H_l^2) over the levels of a grid (L, T, F): its gradient is added to what autograd gave.
Its value, before the step, is written as one sum for each warp, on a CPU for each thread. Neither depends on the order
of threads.
"""

import functools

import warp as wp

from nexwarp.native.warp import lane_index, warp_size, warp_sum

VALUES, CPU_VALUES = 4, 1024  # of a thread

_STEP = """
#if defined(__CUDA_ARCH__)
    const size_t at = VALUES * (size_t)thread, count = values.shape[0];
    const int size = at + VALUES <= count ? VALUES : (at < count ? (int)(count - at) : 0);
    auto read = [&](const wp::float32* from, wp::float32* to) {
        if (size == VALUES) {
            const float4 x = *reinterpret_cast<const float4*>(from + at);
            to[0] = x.x; to[1] = x.y; to[2] = x.z; to[3] = x.w;
        } else {
            for (int k = 0; k < VALUES; ++k) to[k] = k < size ? from[at + k] : 0.0f;
        }
    };
    auto write = [&](wp::float32* to, const wp::float32* from) {
        if (size == VALUES) {
            *reinterpret_cast<float4*>(to + at) = make_float4(from[0], from[1], from[2], from[3]);
        } else {
            for (int k = 0; k < VALUES; ++k) if (k < size) to[at + k] = from[k];
        }
    };
    wp::float32 p[VALUES], g[VALUES] = {}, m[VALUES], v[VALUES];
    read(values.data, p);
    read(means.data, m);
    read(squares.data, v);
    if (grads.shape[0] > 0) read(grads.data, g);
    wp::float32 loss = 0.0f;
    for (int k = 0; k < VALUES; ++k) {
        if (factors.shape[0] > 0 && k < size) {
            const wp::float32 pull = factors.data[(at + k) >> level_bits] * p[k];
            g[k] += 2.0f * pull;
            loss += pull * p[k];
        }
        m[k] = beta1 * m[k] + rest1 * g[k];
        v[k] = beta2 * v[k] + rest2 * g[k] * g[k];
        p[k] -= rate * m[k] / (sqrtf(v[k]) * correction + epsilon);
    }
    write(values.data, p);
    write(means.data, m);
    write(squares.data, v);
    if (halves.shape[0] > 0) {
        unsigned words[2];
        for (int k = 0; k < 2; ++k)
            asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(words[k]) : "f"(p[2 * k + 1]), "f"(p[2 * k]));
        if (size == VALUES) {
            *reinterpret_cast<uint2*>(halves.data + at) = make_uint2(words[0], words[1]);
        } else {
            for (int k = 0; k < VALUES; ++k) if (k < size) halves.data[at + k] = wp::half(p[k]);
        }
    }
    return loss;
#else
    typedef float reals_t __attribute__((ext_vector_type(16)));
    const size_t first = CPU_VALUES * (size_t)thread, count = values.shape[0];
    reals_t loss = 0.0f;
    for (size_t at = first; at < first + CPU_VALUES && at < count; at += 16) {
        const int size = at + 16 <= count ? 16 : (int)(count - at);
        auto read = [&](const wp::float32* from) {
            reals_t x = 0.0f;
            if (size == 16)
                __builtin_memcpy(&x, from + at, sizeof(x));
            else
                for (int k = 0; k < size; ++k) x[k] = from[at + k];
            return x;
        };
        auto write = [&](wp::float32* to, reals_t x) {
            if (size == 16)
                __builtin_memcpy(to + at, &x, sizeof(x));
            else
                for (int k = 0; k < size; ++k) to[at + k] = x[k];
        };
        reals_t p = read(values.data), g = grads.shape[0] > 0 ? read(grads.data) : (reals_t)(0.0f);
        if (factors.shape[0] > 0) {
            reals_t factor = factors.data[at >> level_bits];
            if (level_bits < 4)
                for (int k = 1; k < size; ++k) factor[k] = factors.data[(at + k) >> level_bits];
            const reals_t pull = factor * p;
            g += 2.0f * pull;
            loss += pull * p;
        }
        const reals_t m = beta1 * read(means.data) + rest1 * g;
        const reals_t v = beta2 * read(squares.data) + rest2 * g * g;
        p -= rate * m / (__builtin_elementwise_sqrt(v) * correction + epsilon);
        write(values.data, p);
        write(means.data, m);
        write(squares.data, v);
        for (int k = 0; k < size && halves.shape[0] > 0; ++k) halves.data[at + k] = wp::half(p[k]);
    }
    wp::float32 sum = 0.0f;
    for (int k = 0; k < 16; ++k) sum += loss[k];
    return sum;
#endif
""".replace("CPU_VALUES", str(CPU_VALUES)).replace("VALUES", str(VALUES))

# 1 - beta^count, which is small in the first steps: in double precision, or by the function made for that.
_REST = """
#if defined(__CUDA_ARCH__)
    return -expm1f(log_beta * count);
#else
    return (float)(1.0 - wp::exp((double)log_beta * count));
#endif
"""

Real = wp.array(dtype=wp.float32)


@wp.func_native(_REST)
def rest_of_power(log_beta: wp.float32, count: wp.float32) -> wp.float32:
    """Return 1 - exp(log_beta * count)."""
    ...


@functools.cache
def adam_kernel() -> wp.Kernel:
    """Make the kernel; parameters and moments are flat float32, on CUDA from addresses that are multiples of 16."""

    @wp.func_native(_STEP)
    def update(  # noqa: PLR0913  # the body of a kernel entry point
        thread: wp.int32,
        values: Real,
        grads: Real,
        means: Real,
        squares: Real,
        halves: wp.array(dtype=wp.float16),
        factors: Real,
        level_bits: wp.int32,
        beta1: wp.float32,
        beta2: wp.float32,
        rest1: wp.float32,
        rest2: wp.float32,
        rate: wp.float32,
        correction: wp.float32,
        epsilon: wp.float32,
    ) -> wp.float32: ...

    @wp.kernel(enable_backward=False, module="unique")
    def adam(  # noqa: PLR0913  # a kernel entry point
        first: wp.int32,
        grads: Real,
        factors: Real,
        level_bits: wp.int32,
        step: Real,
        rates: Real,
        beta1: wp.float32,
        beta2: wp.float32,
        rest1: wp.float32,
        rest2: wp.float32,
        log_beta1: wp.float32,
        log_beta2: wp.float32,
        epsilon: wp.float32,
        # read and written
        values: Real,
        means: Real,
        squares: Real,
        # outputs
        halves: wp.array(dtype=wp.float16),
        losses: Real,
    ):
        thread = first + wp.tid()
        rate = rates[0] / rest_of_power(log_beta1, step[0])
        correction = 1.0 / wp.sqrt(rest_of_power(log_beta2, step[0]))
        loss = update(
            thread,
            values,
            grads,
            means,
            squares,
            halves,
            factors,
            level_bits,
            beta1,
            beta2,
            rest1,
            rest2,
            rate,
            correction,
            epsilon,
        )
        if losses.shape[0] > 0:
            loss = warp_sum(loss)
            if lane_index() == 0:
                losses[thread // warp_size()] = loss

    return adam
