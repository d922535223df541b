"""Activation: raw parameters to what the passes read, all in one go. One thread a surfel, forward and backward.

The backward kernel writes what `wp.grad` gives for the product of outputs and their gradients; nothing is added up.
"""

from __future__ import annotations

import warp as wp

from nexwarp.kernels.types import Real, Vec2, Vec4, per_real

# Quaternions shorter than this are divided by it: torch.nn.functional.normalize's.
SHORTEST = wp.constant(wp.float64(1e-12))


@wp.func
def unit(quat: Vec4):
    """Quaternion over its length."""
    return quat / wp.max(wp.length(quat), quat.dtype(SHORTEST))


@wp.func
def exponentials(x: Vec2):
    """Exponential of each component."""
    return wp.vector(wp.exp(x[0]), wp.exp(x[1]))


@wp.func
def sigmoid(x: Real):
    """1 / (1 + exp(-x))."""
    # The exponential must not overflow: the adjoint of 1 / (1 + exp(-x)) would be 0 * inf there.
    one = type(x)(1.0)
    e = wp.exp(-wp.abs(x))
    return wp.where(x < type(x)(0.0), e, one) / (one + e)


@wp.func
def activated_dot(
    quat: Vec4,
    scale: Vec2,
    opacity: Real,
    gamma: Vec2,
    grad_quat: Vec4,
    grad_scale: Vec2,
    grad_opacity: Real,
    grad_gamma: Vec2,
):
    """Sum of outputs * gradients (a constant is left out): its gradient is the vector-Jacobian product."""
    return (
        unit_dot(quat, grad_quat)
        + wp.exp(scale[0]) * grad_scale[0]
        + wp.exp(scale[1]) * grad_scale[1]
        + sigmoid(opacity) * grad_opacity
        + wp.exp(gamma[0]) * grad_gamma[0]
        + wp.exp(gamma[1]) * grad_gamma[1]
    )


@wp.func
def unit_dot(quat: Vec4, grad: Vec4):
    """Unit quaternion times its gradient: its gradient is the vector-Jacobian product."""
    return wp.dot(unit(quat), grad)


@per_real()
def activate(first: int, raw: Parameters, activated: Parameters):
    i = first + wp.tid()
    activated.quats[i] = unit(raw.quats[i])
    activated.scales[i] = exponentials(raw.scales[i])
    activated.opacities[i] = sigmoid(raw.opacities[i])
    activated.gammas[i] = vec2(ONE, ONE) + exponentials(raw.gammas[i])


@per_real()
def activate_backward(first: int, raw: Parameters, grads: Parameters, grad_raw: Parameters):
    i = first + wp.tid()
    quat, scale, opacity, gamma, _q, _s, _o, _g = wp.grad(activated_dot)(
        raw.quats[i],
        raw.scales[i],
        raw.opacities[i],
        raw.gammas[i],
        grads.quats[i],
        grads.scales[i],
        grads.opacities[i],
        grads.gammas[i],
    )
    grad_raw.quats[i] = quat
    grad_raw.scales[i] = scale
    grad_raw.opacities[i] = opacity
    grad_raw.gammas[i] = gamma
