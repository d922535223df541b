"""Composition (paper Eq. 7): image = plain + textured + (1 - alpha) background, textured = base + sum_k weight_k T_k.

A thread is a pixel. Read: the buffers of `collect`, the textured colours T (P, K) and the background; without `base`, a
null array, it is 0. Written: image and textured; backward, the gradients of all that is read but the background, where
an array for them is given.
"""

from __future__ import annotations

import warp as wp

from nexwarp.kernels.types import per_real


@per_real()
def compose(first: int, layers: Layers, image: vec3s, textured: vec3s):
    p = first + wp.tid()
    total = vec3()
    if layers.base:
        total += layers.base[p]
    for h in range(layers.weights.shape[1]):
        total += layers.colors[p, h] * layers.weights[p, h]
    textured[p] = total
    image[p] = layers.plain[p] + total + layers.background[0] * (ONE - layers.alphas[p])


@per_real()
def compose_backward(first: int, layers: Layers, grad_image: vec3s, grad_textured: vec3s, grads: Layers):
    p = first + wp.tid()
    of_image = vec3()
    if grad_image:
        of_image = grad_image[p]
    total = of_image
    if grad_textured:
        total += grad_textured[p]
    if grads.base:
        grads.base[p] = total
    if grads.alphas:
        grads.alphas[p] = -wp.dot(of_image, layers.background[0])
    for h in range(layers.weights.shape[1]):
        if grads.colors:
            grads.colors[p, h] = total * layers.weights[p, h]
        if grads.weights:
            grads.weights[p, h] = wp.dot(layers.colors[p, h], total)
