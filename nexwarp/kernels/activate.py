"""Activation: raw parameters to what the passes read, all in one go. One thread a surfel, forward and backward.

The backward kernel writes what `wp.grad` gives for the product of outputs and their gradients; nothing is added up.
"""

import functools
from types import SimpleNamespace

import warp as wp

from nexwarp.kernels.types import types

# Quaternions shorter than this are divided by it: torch.nn.functional.normalize's.
SHORTEST = 1e-12


@functools.cache
def activate_kernels(real: type) -> SimpleNamespace:
    """Make the kernels of quaternion / length, exp, sigmoid and 1 + exp."""
    t = types(real)
    vec2, vec4 = t.vec2, t.vec4
    ZERO, ONE, EPS = t.ZERO, t.ONE, wp.constant(real(SHORTEST))

    @wp.func
    def unit(quat: vec4):
        return quat / wp.max(wp.length(quat), EPS)

    @wp.func
    def sigmoid(x: real):
        # The exponential must not overflow: the adjoint of 1 / (1 + exp(-x)) would be 0 * inf there.
        e = wp.exp(-wp.abs(x))
        return wp.where(x < ZERO, e, ONE) / (ONE + e)

    @wp.func
    def activated_dot(
        quat: vec4,
        log_scale: vec2,
        logit: real,
        raw_gamma: vec2,
        grad_quat: vec4,
        grad_scale: vec2,
        grad_opacity: real,
        grad_gamma: vec2,
    ):
        """Sum of outputs * gradients (a constant is left out): its gradient is the vector-Jacobian product."""
        return (
            wp.dot(unit(quat), grad_quat)
            + wp.exp(log_scale[0]) * grad_scale[0]
            + wp.exp(log_scale[1]) * grad_scale[1]
            + sigmoid(logit) * grad_opacity
            + wp.exp(raw_gamma[0]) * grad_gamma[0]
            + wp.exp(raw_gamma[1]) * grad_gamma[1]
        )

    @wp.kernel(enable_backward=False, module="unique")
    def activate(
        first: wp.int32,
        raw_quats: wp.array(dtype=vec4),
        log_scales: wp.array(dtype=vec2),
        logit_opacities: wp.array(dtype=real),
        raw_gammas: wp.array(dtype=vec2),
        # outputs
        quats: wp.array(dtype=vec4),
        scales: wp.array(dtype=vec2),
        opacities: wp.array(dtype=real),
        gammas: wp.array(dtype=vec2),
    ):
        i = first + wp.tid()
        log_scale = log_scales[i]
        raw_gamma = raw_gammas[i]
        quats[i] = unit(raw_quats[i])
        scales[i] = vec2(wp.exp(log_scale[0]), wp.exp(log_scale[1]))
        opacities[i] = sigmoid(logit_opacities[i])
        gammas[i] = vec2(ONE + wp.exp(raw_gamma[0]), ONE + wp.exp(raw_gamma[1]))

    @wp.kernel(enable_backward=False, module="unique")
    def activate_backward(
        first: wp.int32,
        raw_quats: wp.array(dtype=vec4),
        log_scales: wp.array(dtype=vec2),
        logit_opacities: wp.array(dtype=real),
        raw_gammas: wp.array(dtype=vec2),
        grad_quats: wp.array(dtype=vec4),
        grad_scales: wp.array(dtype=vec2),
        grad_opacities: wp.array(dtype=real),
        grad_gammas: wp.array(dtype=vec2),
        # outputs
        grad_raw_quats: wp.array(dtype=vec4),
        grad_log_scales: wp.array(dtype=vec2),
        grad_logit_opacities: wp.array(dtype=real),
        grad_raw_gammas: wp.array(dtype=vec2),
    ):
        i = first + wp.tid()
        quat, log_scale, logit, raw_gamma, _q, _s, _o, _g = wp.grad(activated_dot)(
            raw_quats[i],
            log_scales[i],
            logit_opacities[i],
            raw_gammas[i],
            grad_quats[i],
            grad_scales[i],
            grad_opacities[i],
            grad_gammas[i],
        )
        grad_raw_quats[i] = quat
        grad_log_scales[i] = log_scale
        grad_logit_opacities[i] = logit
        grad_raw_gammas[i] = raw_gamma

    return SimpleNamespace(forward=activate, backward=activate_backward)
