"""Activation: raw parameters to what the passes read, all in one go. One thread a surfel, forward and backward.

The backward kernel takes derivatives by `wp.grad`, but for exponentials, which are their own; nothing is added up.
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
def unit_dot(quat: Vec4, grad: Vec4):
    """Unit quaternion times its gradient: its gradient is the vector-Jacobian product."""
    return wp.dot(unit(quat), grad)


@wp.func
def sigmoid_dot(x: Real, grad: Real):
    """Sigmoid times its gradient, likewise."""
    return sigmoid(x) * grad


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
    quat, _unit = wp.grad(unit_dot)(raw.quats[i], grads.quats[i])
    opacity, _sigmoid = wp.grad(sigmoid_dot)(raw.opacities[i], grads.opacities[i])
    grad_raw.quats[i] = quat
    grad_raw.scales[i] = wp.cw_mul(exponentials(raw.scales[i]), grads.scales[i])
    grad_raw.opacities[i] = opacity
    grad_raw.gammas[i] = wp.cw_mul(exponentials(raw.gammas[i]), grads.gammas[i])
