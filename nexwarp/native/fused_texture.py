"""Text of the fused texturing kernels, a CUDA program for one warp; see `nexwarp.kernels.fused_texture`."""

from nexwarp.native.mma import PRELUDE, PRODUCTS, TRANSPOSED

FEATURES, WIDTH = 32, 64  # of the shapes that these kernels take: L * F, and both hidden layers
OUTPUTS = 48  # of the last matrix, those of SH degree 3; lower degrees have zeros there
WARPS = 4  # of a block of the backward kernel

# (tiles of 16 of the inner dimension, tiles of 8 columns) of each packed matrix, in their order.
MATRICES = {"W1": (2, 8), "W2": (4, 8), "W3": (4, 6), "W3T": (3, 8), "W2T": (4, 8), "W1T": (4, 4)}
# How many values the gradients of the three matrices have, in permuted order.
GRADIENTS = (WIDTH * FEATURES, WIDTH * WIDTH, OUTPUTS * WIDTH)


def offsets() -> dict[str, int]:
    """Return the first word of each packed matrix."""
    first, end = {}, 0
    for name, (k_tiles, n_tiles) in MATRICES.items():
        first[name] = end
        end += n_tiles * ((k_tiles + 1) // 2) * 128
    return first


def logical_feature(column: int, features: int) -> int:
    """Return which of the L * F features stands in a column of the first matrix."""
    if features == 2:
        return column
    level = 4 * (column >> 4) + ((column >> 1) & 3)
    return 4 * level + (column & 1) + 2 * ((column >> 3) & 1)


def logical_output(column: int) -> int:
    """Return which output, coefficient * 3 + channel, stands in a column of the last product."""
    place = 2 * (column >> 3) + (column & 1)
    coefficient = ((column >> 1) & 3) + 4 * (place // 3)
    return 3 * coefficient + place % 3


def constants(**values: int) -> str:
    """C++ that declares integers."""
    return "".join(f"    constexpr int {name} = {value};\n" for name, value in values.items())


# Of a lane's two points, rows g and g + 8 of a tile, the pixels, -1 beyond the image; and the basis functions q, q + 4,
# q + 8 and q + 12 at a unit direction, see `nexwarp.kernels.sh.basis`.
_PIXELS = """
    const float* toward = reinterpret_cast<const float*>(directions.data);
    const int across = (width + (1 << shift) - 1) >> shift;
    const int tiles = across * ((height + (16 >> shift) - 1) >> (4 - shift));
    auto basis = [](float x, float y, float z, int q, float* out) {
        const float xx = x * x, yy = y * y, zz = z * z;
        const float all[] = {
            0.28209479177387814f,
            -0.4886025119029199f * y,
            0.4886025119029199f * z,
            -0.4886025119029199f * x,
            1.0925484305920792f * x * y,
            -1.0925484305920792f * y * z,
            0.31539156525252005f * (2.0f * zz - xx - yy),
            -1.0925484305920792f * x * z,
            0.5462742152960396f * (xx - yy),
            -0.5900435899266435f * y * (3.0f * xx - yy),
            2.890611442640554f * x * y * z,
            -0.4570457994644658f * y * (4.0f * zz - xx - yy),
            0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy),
            -0.4570457994644658f * x * (4.0f * zz - xx - yy),
            1.445305721320277f * z * (xx - yy),
            -0.5900435899266435f * x * (xx - 3.0f * yy)};
        for (int j = 0; j < 4; ++j)
            out[j] = q < 2 ? (q == 0 ? all[4 * j] : all[4 * j + 1]) : (q == 2 ? all[4 * j + 2] : all[4 * j + 3]);
    };
    auto find_pixels = [&](int tile, int* pixel, wp::float32 (*b)[4]) {
        #pragma unroll
        for (int i = 0; i < 2; ++i) {
            const int row = (lane >> 2) + 8 * i;
            const int x = ((tile % across) << shift) + (row & ((1 << shift) - 1));
            const int y = ((tile / across) << (4 - shift)) + (row >> shift);
            pixel[i] = x < width && y < height ? y * width + x : -1;
        }
        #pragma unroll
        for (int i = 0; i < 2; ++i) {
            const float* from = toward + 3 * (size_t)(pixel[i] < 0 ? 0 : pixel[i]);
            basis(from[0], from[1], from[2], lane & 3, b[i]);
        }
    };
    auto hidden = [&](auto& out) {
        return [&](int n, const float* d) {
            out[n >> 1][(n & 1) * 2] = relu_halves(d[0], d[1]);
            out[n >> 1][(n & 1) * 2 + 1] = relu_halves(d[2], d[3]);
        };
    };
"""

_FORWARD = """
    const float focal_length = focal.data[0];
    const float* places = reinterpret_cast<const float*>(positions.data);
    auto map_positive = [](int i) { return (unsigned)(i > 0 ? 2 * i - 1 : -2 * i); };
    // Features of a point at one level, as words of two halves.
    auto look_up = [&](int level, const float* at, float depth, unsigned* out) {
        const float scale = resolutions.data[level];
        const float x = at[0] * scale, y = at[1] * scale, z = at[2] * scale;
        const float bx = floorf(x), by = floorf(y), bz = floorf(z);
        const float ratio = focal_length / (scale * depth);
        const float fade = 1.0f - __expf(-0.15915494309189535f * ratio * ratio);
        const float wx[2] = {1.0f - (x - bx), x - bx}, wy[2] = {1.0f - (y - by), y - by};
        const float wz[2] = {(1.0f - (z - bz)) * fade, (z - bz) * fade};
        const int cx = (int)bx, cy = (int)by, cz = (int)bz;
        const unsigned hx[2] = {map_positive(cx), map_positive(cx + 1)};
        const unsigned hy[2] = {map_positive(cy) * 2654435761u, map_positive(cy + 1) * 2654435761u};
        const unsigned hz[2] = {map_positive(cz) * 805459861u, map_positive(cz + 1) * 805459861u};
        const unsigned* rows = reinterpret_cast<const unsigned*>(table.data) + (size_t)level * (mask + 1u) * (F / 2);
        float sum[F] = {};
        #pragma unroll
        for (int j = 0; j < 8; ++j) {
            const unsigned slot = (hx[j & 1] ^ hy[(j >> 1) & 1] ^ hz[j >> 2]) & mask;
            const unsigned* row = rows + (size_t)slot * (F / 2);
            unsigned word[F / 2];
            if (F == 4) {
                const uint2 both = __ldg(reinterpret_cast<const uint2*>(row));
                word[0] = both.x; word[F / 2 - 1] = both.y;
            } else word[0] = __ldg(row);
            const float weight = wx[j & 1] * wy[(j >> 1) & 1] * wz[j >> 2];
            #pragma unroll
            for (int f = 0; f < F / 2; ++f) {
                sum[2 * f] += weight * low_half(word[f]);
                sum[2 * f + 1] += weight * high_half(word[f]);
            }
        }
        #pragma unroll
        for (int f = 0; f < F / 2; ++f) out[f] = halves(sum[2 * f], sum[2 * f + 1]);
    };
    __shared__ unsigned matrices[W3T];
    for (int i = threadIdx.x; i < W3T / 4; i += blockDim.x)
        reinterpret_cast<uint4*>(matrices)[i] = reinterpret_cast<const uint4*>(packed.data)[i];
    __syncthreads();
    for (int tile = thread >> 5; tile < tiles; tile += threads >> 5) {
        int pixel[2];
        float b[2][4];
        find_pixels(tile, pixel, b);
        #pragma unroll 1
        for (int hit = 0; hit < hits; ++hit) {
            unsigned x[2][4];
            int seen = 0;
            #pragma unroll
            for (int i = 0; i < 2; ++i) {
                const size_t point = (size_t)pixel[i] * hits + hit;
                const float depth = pixel[i] < 0 ? 0.0f : depths.data[point];
                #pragma unroll
                for (int t = 0; t < 2; ++t) x[t][i] = x[t][2 + i] = 0u;
                if (depth > 0.0f) {
                    seen = 1;
                    const float at[3] = {places[3 * point], places[3 * point + 1], places[3 * point + 2]};
                    #pragma unroll
                    for (int t = 0; t < 2; ++t) {
                        unsigned word[2];
                        if (F == 4) {
                            look_up(4 * t + (lane & 3), at, depth, word);
                            x[t][i] = word[0];
                            x[t][2 + i] = word[F / 2 - 1];
                        } else {
                            look_up(8 * t + (lane & 3), at, depth, word);
                            x[t][i] = word[0];
                            look_up(8 * t + 4 + (lane & 3), at, depth, word);
                            x[t][2 + i] = word[0];
                        }
                    }
                }
            }
            if (encoded.shape[0] > 0) {
                uint4* to = reinterpret_cast<uint4*>(encoded.data) + ((size_t)tile * hits + hit) * 64;
                #pragma unroll
                for (int t = 0; t < 2; ++t) to[t * 32 + lane] = make_uint4(x[t][0], x[t][1], x[t][2], x[t][3]);
            }
            float sum[2][3] = {};
            if (__any_sync(0xffffffffu, seen)) {
                unsigned y[4][4], z[4][4];
                product(x, matrices + W1, 8, hidden(y));
                product(y, matrices + W2, 8, hidden(z));
                product(z, matrices + W3, 6, [&](int n, const float* d) {
                    #pragma unroll
                    for (int e = 0; e < 2; ++e) {
                        const int u = 2 * n + e;
                        sum[0][u % 3] += d[e] * b[0][u / 3];
                        sum[1][u % 3] += d[2 + e] * b[1][u / 3];
                    }
                });
                #pragma unroll
                for (int i = 0; i < 2; ++i) for (int c = 0; c < 3; ++c) {
                    sum[i][c] += __shfl_xor_sync(0xffffffffu, sum[i][c], 1);
                    sum[i][c] += __shfl_xor_sync(0xffffffffu, sum[i][c], 2);
                }
            }
            const int channel = lane & 3;
            #pragma unroll
            for (int i = 0; i < 2; ++i) {
                float value = channel == 0 ? sum[i][0] : channel == 1 ? sum[i][1] : sum[i][2];
                value += offset;
                if (clamp && value < 0.0f) value = 0.0f;
                if (channel < 3 && pixel[i] >= 0)
                    reinterpret_cast<float*>(colors.data)[3 * ((size_t)pixel[i] * hits + hit) + channel] = value;
            }
        }
    }
"""

_BACKWARD = """
    __shared__ __align__(16) unsigned stages[4][WARPS * 16 * ROW], early[WARPS * 16 * ROW];
    const int warp = threadIdx.x >> 5, block = thread / (32 * WARPS), blocks = threads / (32 * WARPS);
    // The part of each matrix's gradient that this warp sums: rows, and pairs of tiles of columns.
    const int half_m = warp % 2, half_p = warp / 2;
    float sum3[3][2][4] = {}, sum2[2][4][4] = {}, sum1[2][2][4] = {};
    const unsigned* matrices = reinterpret_cast<const unsigned*>(packed.data);
    const float scaled = scale.data[0];
    const int units = tiles * hits;
    auto put = [&](unsigned* to, const auto& source) {
        #pragma unroll
        for (int t = 0; t < sizeof(source) / sizeof(source[0]); ++t) {
            #pragma unroll
            for (int r = 0; r < 4; ++r) {
                const int row = warp * 16 + (lane >> 2) + 8 * (r & 1);
                to[row * ROW + t * 8 + (r >> 1) * 4 + (lane & 3)] = source[t][r];
            }
        }
    };
    // Add a warp's part of left^T right over the points of all warps of the block.
    auto accumulate = [&](auto& sum, const unsigned* lefts, const unsigned* rights, int first_m, int first_p) {
        constexpr int ROWS = sizeof(sum) / sizeof(sum[0]), PAIRS = sizeof(sum[0]) / sizeof(sum[0][0]) / 2;
        #pragma unroll 1
        for (int s = 0; s < WARPS; ++s) {
            unsigned right[PAIRS][4];
            #pragma unroll
            for (int p = 0; p < PAIRS; ++p) transposed(rights, s, first_p + p, false, right[p]);
            #pragma unroll
            for (int m = 0; m < ROWS; ++m) {
                unsigned left[4];
                transposed(lefts, s, first_m + m, true, left);
                #pragma unroll
                for (int p = 0; p < PAIRS; ++p) {
                    multiply_add(sum[m][2 * p], left, right[p]);
                    multiply_add(sum[m][2 * p + 1], left, right[p] + 2);
                }
            }
        }
    };
    auto keep = [&](const auto& sum, float* slots, int columns, int first_m, int first_p) {
        constexpr int ROWS = sizeof(sum) / sizeof(sum[0]), TILES = sizeof(sum[0]) / sizeof(sum[0][0]);
        #pragma unroll
        for (int m = 0; m < ROWS; ++m) {
            #pragma unroll
            for (int n = 0; n < TILES; ++n) {
                #pragma unroll
                for (int r = 0; r < 4; ++r) {
                    const int row = (first_m + m) * 16 + (lane >> 2) + 8 * (r >> 1);
                    const int column = (first_p * 2 + n) * 8 + 2 * (lane & 3) + (r & 1);
                    slots[row * columns + column] = sum[m][n][r];
                }
            }
        }
    };
    // Gradient of what a hidden layer was before its ReLU: 0 where the layer is.
    auto masked = [&](auto& out, auto layer) {
        return [&, layer](int n, const float* d) {
            #pragma unroll
            for (int i = 0; i < 2; ++i) {
                const unsigned kept = layer(n, i);
                const float first = kept & 0xffffu ? d[2 * i] : 0.0f, second = kept >> 16 ? d[2 * i + 1] : 0.0f;
                out[n >> 1][(n & 1) * 2 + i] = halves(first, second);
            }
        };
    };
    // Two pairs of stages take turns, so that one barrier a layer suffices.
    unsigned (*stage)[WARPS * 16 * ROW] = stages;
    auto turn = [&] { stage = stage == stages ? stages + 2 : stages; };
    #pragma unroll 1
    for (int first = block * WARPS; first < units; first += blocks * WARPS) {
        const int unit = first + warp, tile = unit / hits, hit = unit % hits;
        const bool here = unit < units;
        unsigned x[2][4], y[4][4], z[4][4], g[3][4];
        {
            int pixel[2];
            float b[2][4];
            find_pixels(tile, pixel, b);
            #pragma unroll
            for (int i = 0; i < 2; ++i) {
                const size_t point = (size_t)pixel[i] * hits + hit;
                float grad[3] = {};
                if (here && pixel[i] >= 0) {
                    #pragma unroll
                    for (int c = 0; c < 3; ++c) {
                        grad[c] = reinterpret_cast<const float*>(grad_colors.data)[3 * point + c] * scaled;
                        if (clamped.shape[0] == 0) continue;
                        const float color = reinterpret_cast<const float*>(clamped.data)[3 * point + c];
                        if (!(color > 0.0f)) grad[c] = 0.0f;
                    }
                }
                float value[12] = {};
                #pragma unroll
                for (int u = 0; u < 12; ++u) value[u] = grad[u % 3] * b[i][u / 3];
                #pragma unroll
                for (int t = 0; t < 3; ++t) {
                    g[t][i] = halves(value[4 * t], value[4 * t + 1]);
                    g[t][2 + i] = halves(value[4 * t + 2], value[4 * t + 3]);
                }
            }
        }
        auto read_features = [&] {
            const unsigned* from = reinterpret_cast<const unsigned*>(encoded.data) + (size_t)unit * 256;
            #pragma unroll
            for (int t = 0; t < 2; ++t) {
                if (here) read_four(from + (t * 32 + lane) * 4, x[t]);
                else x[t][0] = x[t][1] = x[t][2] = x[t][3] = 0u;
            }
        };
        read_features();
        product(x, matrices + W1, 8, hidden(y));
        product(y, matrices + W2, 8, hidden(z));
        put(early, y);
        put(stage[0], g);
        put(stage[1], z);
        __syncthreads();
        accumulate(sum3, stage[0], stage[1], 0, warp);
        unsigned dz[4][4], dy[4][4], even[2];
        product(g, matrices + W3T, 8, masked(dz, [&](int n, int i) { return z[n >> 1][(n & 1) * 2 + i]; }));
        turn();
        put(stage[0], dz);
        __syncthreads();
        accumulate(sum2, stage[0], early, half_m * 2, half_p * 2);
        product(dz, matrices + W2T, 8, masked(dy, [&](int n, int i) {
            return early[(warp * 16 + (lane >> 2) + 8 * i) * ROW + (n >> 1) * 8 + (n & 1) * 4 + (lane & 3)];
        }));
        turn();
        read_features();
        put(stage[0], dy);
        put(stage[1], x);
        __syncthreads();
        accumulate(sum1, stage[0], stage[1], half_m * 2, half_p);
        // The gradient of the features: tiles 2 t and 2 t + 1 of D are whole levels of a lane's two points.
        product(dy, matrices + W1T, 4, [&](int n, const float* d) {
            #pragma unroll
            for (int i = 0; i < 2; ++i) {
                const unsigned word = halves(d[2 * i], d[2 * i + 1]);
                const int row = (lane >> 2) + 8 * i;
                unsigned* to = reinterpret_cast<unsigned*>(grad_encoded.data) + (size_t)unit * 256;
                if (F == 2) {
                    if (here) to[(4 * n + (lane & 3)) * 16 + row] = word;
                } else if (n & 1) {
                    to += 2 * ((2 * (n - 1) + (lane & 3)) * 16 + row);
                    if (here) *reinterpret_cast<uint2*>(to) = make_uint2(even[i], word);
                } else even[i] = word;
            }
        });
        turn();
    }
    float* slots = grad_matrices.data + (size_t)block * (GRADIENTS1 + GRADIENTS2 + GRADIENTS3);
    keep(sum1, slots, FEATURES, half_m * 2, half_p);
    keep(sum2, slots + GRADIENTS1, WIDTH, half_m * 2, half_p * 2);
    keep(sum3, slots + GRADIENTS1 + GRADIENTS2, WIDTH, 0, warp);
"""


def forward_text(features: int) -> str:
    """Return the text of the forward pass, for F = 2 or 4."""
    return constants(F=features, **offsets()) + PRELUDE + PRODUCTS + _PIXELS + _FORWARD


def backward_text(features: int) -> str:
    """Return the text of the backward pass down to the features, for F = 2 or 4."""
    sizes = {f"GRADIENTS{i}": size for i, size in enumerate(GRADIENTS, 1)}
    # Rows of 64 halves are padded to 36 words, so that eight of them lie in different banks.
    head = constants(F=features, FEATURES=FEATURES, WIDTH=WIDTH, WARPS=WARPS, ROW=36, **sizes, **offsets())
    return head + PRELUDE + PRODUCTS + TRANSPOSED + _PIXELS + _BACKWARD
