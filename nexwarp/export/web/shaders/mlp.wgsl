// The MLP and the colour of its spherical harmonics, in loops: for networks too large to unroll.

fn mlp_color(x: ptr<function, array<Weight, INPUTS>>, direction: vec3f) -> vec3f {
    var h: array<Weight, max(INPUTS, WIDTH)>;
    for (var i = 0u; i < INPUTS; i++) {
        h[i] = (*x)[i];
    }
    var at = 0u;
    var inputs = INPUTS;
    for (var layer = 0u; layer < HIDDEN; layer++) {
        var next: array<Weight, max(INPUTS, WIDTH)>;
        for (var o = 0u; o < WIDTH; o++) {
            var sum = vec4f(0.0);
            for (var i = 0u; i < inputs; i++) {
                sum += block_product(at, h[i]);
                at += 1u;
            }
            next[o] = activation(sum);
        }
        h = next;
        inputs = WIDTH;
    }
    var color = vec3f(0.0);
    for (var channel = 0u; channel < 3u; channel++) {
        for (var block = 0u; block < BLOCKS; block++) {
            if (block < USED_BLOCKS) {
                var sum = vec4f(0.0);
                for (var i = 0u; i < inputs; i++) {
                    sum += block_product(at + i, h[i]);
                }
                color[channel] += dot(sum, basis(block, direction) * used(block));
            }
            at += inputs;
        }
    }
    return color;
}
