"""Text of the fused texturing kernels, a program for one warp; see `nexwarp.kernels.fused_texture`."""

from nexwarp.native.mma import PRELUDE, TRANSPOSED, product

FEATURES, WIDTH = 32, 64  # of the shapes that these kernels take: L * F, and both hidden layers
OUTPUTS = 48  # of the last matrix, those of SH degree 3; lower degrees have zeros there
WARPS = 4  # of a block of the backward kernel

# (tiles of 16 of the inner dimension, tiles of 8 columns) of each packed matrix, in their order.
MATRICES = {"W1": (2, 8), "W2": (4, 8), "W3": (4, 6), "W3T": (3, 8), "W2T": (4, 8), "W1T": (4, 4)}
# How many values the gradients of the three matrices have, in permuted order.
GRADIENTS = (WIDTH * FEATURES, WIDTH * WIDTH, OUTPUTS * WIDTH)


def offsets() -> dict[str, int]:
    """Return the first word of each packed matrix."""
    found, end = {}, 0
    for name, (k_tiles, n_tiles) in MATRICES.items():
        found[name] = end
        end += n_tiles * ((k_tiles + 1) // 2) * 128
    return found


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


def _constants(**values: int) -> str:
    return "".join(f"    constexpr int {name} = {value};\n" for name, value in values.items())


# The basis functions q, q + 4, q + 8 and q + 12 at a unit direction; see `nexwarp.kernels.sh.basis_function`.
_BASIS = """
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
"""

# The two points of a lane, rows g and g + 8 of a tile: their pixels, -1 beyond the image.
_PIXELS = """
            int pixel[2][LANES];
            EACH_LANE {
                UNROLL
                for (int i = 0; i < 2; ++i) {
                    const int row = (lane >> 2) + 8 * i;
                    const int x = ((tile % across) << shift) + (row & ((1 << shift) - 1));
                    const int y = ((tile / across) << (4 - shift)) + (row >> shift);
                    pixel[i][l] = x < width && y < height ? y * width + x : -1;
                }
            }
            float b[2][MINE][LANES];
            EACH_LANE {
                UNROLL
                for (int i = 0; i < 2; ++i) {
                    const float* from = toward + 3 * (size_t)(pixel[i][l] < 0 ? 0 : pixel[i][l]);
                    float mine[MINE];
                    basis(from[0], from[1], from[2], lane & 3, mine);
                    UNROLL
                    for (int j = 0; j < MINE; ++j) b[i][j][l] = mine[j];
                }
            }
"""

_LOOKUP = """
    const float focal_length = focal.data[0];
    auto map_positive = [](int i) { return (unsigned)(i > 0 ? 2 * i - 1 : -2 * i); };
    // Features of a point at one level, as words of two halves.
    auto look_up = [&](int level, const float* at, float depth, unsigned* out) {
        const float scale = resolutions.data[level];
        const float x = at[0] * scale, y = at[1] * scale, z = at[2] * scale;
        const float bx = floorf(x), by = floorf(y), bz = floorf(z);
        const float ratio = focal_length / (scale * depth);
        const float fade = 1.0f - power_of_e(-0.15915494309189535f * ratio * ratio);
        const float wx[2] = {1.0f - (x - bx), x - bx}, wy[2] = {1.0f - (y - by), y - by};
        const float wz[2] = {(1.0f - (z - bz)) * fade, (z - bz) * fade};
        const int cx = (int)bx, cy = (int)by, cz = (int)bz;
        const unsigned hx[2] = {map_positive(cx), map_positive(cx + 1)};
        const unsigned hy[2] = {map_positive(cy) * 2654435761u, map_positive(cy + 1) * 2654435761u};
        const unsigned hz[2] = {map_positive(cz) * 805459861u, map_positive(cz + 1) * 805459861u};
        const unsigned* rows = reinterpret_cast<const unsigned*>(table.data) + (size_t)level * (mask + 1u) * (F / 2);
        float sum[F] = {};
        UNROLL
        for (int j = 0; j < 8; ++j) {
            const unsigned slot = (hx[j & 1] ^ hy[(j >> 1) & 1] ^ hz[j >> 2]) & mask;
            const unsigned* row = rows + (size_t)slot * (F / 2);
            unsigned word[F / 2];
#if defined(__CUDA_ARCH__)
            if (F == 4) {
                const uint2 both = __ldg(reinterpret_cast<const uint2*>(row));
                word[0] = both.x; word[F / 2 - 1] = both.y;
            } else word[0] = __ldg(row);
#else
            for (int f = 0; f < F / 2; ++f) word[f] = row[f];
#endif
            const float weight = wx[j & 1] * wy[(j >> 1) & 1] * wz[j >> 2];
            UNROLL
            for (int f = 0; f < F / 2; ++f) {
                sum[2 * f] += weight * low_half(word[f]);
                sum[2 * f + 1] += weight * high_half(word[f]);
            }
        }
        UNROLL
        for (int f = 0; f < F / 2; ++f) out[f] = halves(sum[2 * f], sum[2 * f + 1]);
    };
"""

_HIDDEN = """
EACH_LANE {
    OUT[n >> 1][(n & 1) * 2][l] = relu_halves(d[0][l], d[1][l]);
    OUT[n >> 1][(n & 1) * 2 + 1][l] = relu_halves(d[2][l], d[3][l]);
}
"""

_FORWARD = """
    const float* toward = reinterpret_cast<const float*>(directions.data);
    const float* places = reinterpret_cast<const float*>(positions.data);
#if defined(__CUDA_ARCH__)
    __shared__ unsigned packed_here[WORDS];
    for (int i = threadIdx.x; i < WORDS / 4; i += blockDim.x)
        reinterpret_cast<uint4*>(packed_here)[i] = reinterpret_cast<const uint4*>(packed.data)[i];
    __syncthreads();
    const unsigned* weights = packed_here;
    const int warp = thread >> 5, warps = threads >> 5;
#else
    const unsigned* weights = reinterpret_cast<const unsigned*>(packed.data);
    const int warp = thread, warps = threads;
#endif
    const int across = (width + (1 << shift) - 1) >> shift;
    const int tiles = across * ((height + (16 >> shift) - 1) >> (4 - shift));
    for (int tile = warp; tile < tiles; tile += warps) {
PIXELS
        #pragma unroll 1
        for (int hit = 0; hit < hits; ++hit) {
            unsigned x[2][4][LANES];
            int seen[LANES];
            EACH_LANE {
                seen[l] = 0;
                UNROLL
                for (int i = 0; i < 2; ++i) {
                    const size_t point = (size_t)pixel[i][l] * hits + hit;
                    const float depth = pixel[i][l] < 0 ? 0.0f : depths.data[point];
                    UNROLL
                    for (int t = 0; t < 2; ++t) x[t][i][l] = x[t][2 + i][l] = 0u;
                    if (depth > 0.0f) {
                        seen[l] = 1;
                        const float at[3] = {places[3 * point], places[3 * point + 1], places[3 * point + 2]};
                        UNROLL
                        for (int t = 0; t < 2; ++t) {
                            unsigned word[2];
                            if (F == 4) {
                                look_up(4 * t + (lane & 3), at, depth, word);
                                x[t][i][l] = word[0];
                                x[t][2 + i][l] = word[F / 2 - 1];
                            } else {
                                look_up(8 * t + (lane & 3), at, depth, word);
                                x[t][i][l] = word[0];
                                look_up(8 * t + 4 + (lane & 3), at, depth, word);
                                x[t][2 + i][l] = word[0];
                            }
                        }
                    }
                }
            }
            if (encoded.shape[0] > 0) {
                unsigned* to = reinterpret_cast<unsigned*>(encoded.data) + ((size_t)tile * hits + hit) * 256;
                EACH_LANE {
                    UNROLL
                    for (int t = 0; t < 2; ++t) write_four(to + (t * 32 + lane) * 4, x[t], l);
                }
            }
            float sum[2][3][LANES] = {};
            if (any_lane(seen)) {
                unsigned y[4][4][LANES], z[4][4][LANES];
LAYERS
                UNROLL
                for (int i = 0; i < 2; ++i) for (int c = 0; c < 3; ++c) sum_over_q(sum[i][c]);
            }
            EACH_LANE {
                const int channel = lane & 3;
                UNROLL
                for (int i = 0; i < 2; ++i) {
                    float value = channel == 0 ? sum[i][0][l] : channel == 1 ? sum[i][1][l] : sum[i][2][l];
                    value += offset;
                    if (clamp && value < 0.0f) value = 0.0f;
                    if (channel < 3 && pixel[i][l] >= 0)
                        reinterpret_cast<float*>(colors.data)[3 * ((size_t)pixel[i][l] * hits + hit) + channel] = value;
                }
            }
        }
    }
"""

_EVALUATE = """
EACH_LANE {
    UNROLL
    for (int e = 0; e < 2; ++e) {
        const int u = 2 * n + e;
        if (u < 3 * MINE) {
            sum[0][u % 3][l] += d[e][l] * b[0][u / 3 < MINE ? u / 3 : 0][l];
            sum[1][u % 3][l] += d[2 + e][l] * b[1][u / 3 < MINE ? u / 3 : 0][l];
        }
    }
}
"""

# Gradient of what a hidden layer was before its ReLU: 0 where the layer is.
_MASKED = """
EACH_LANE {
    UNROLL
    for (int i = 0; i < 2; ++i) {
        const unsigned kept = LAYER;
        const float first = kept & 0xffffu ? d[2 * i][l] : 0.0f, second = kept >> 16 ? d[2 * i + 1][l] : 0.0f;
        OUT[n >> 1][(n & 1) * 2 + i][l] = halves(first, second);
    }
}
"""

# The gradient of the features: tiles 2 t and 2 t + 1 of D are whole levels of a lane's two points.
_FEATURES = """
EACH_LANE {
    UNROLL
    for (int i = 0; i < 2; ++i) {
        const unsigned word = halves(d[2 * i][l], d[2 * i + 1][l]);
        const int row = (lane >> 2) + 8 * i;
        unsigned* to = reinterpret_cast<unsigned*>(grad_encoded.data) + (size_t)unit * 256;
        if (F == 2) {
            if (here) to[(4 * n + (lane & 3)) * 16 + row] = word;
        } else if (n & 1) {
            to += 2 * ((2 * (n - 1) + (lane & 3)) * 16 + row);
#if defined(__CUDA_ARCH__)
            if (here) *reinterpret_cast<uint2*>(to) = make_uint2(even[i][l], word);
#else
            if (here) { to[0] = even[i][l]; to[1] = word; }
#endif
        } else even[i][l] = word;
    }
}
"""

# A word of `early`, where the first hidden layer waits for its turn.
_EARLY = "early[(warp * 16 + (lane >> 2) + 8 * i) * ROW + (n >> 1) * 8 + (n & 1) * 4 + (lane & 3)]"

_STAGE = """
            EACH_LANE {
                UNROLL
                for (int t = 0; t < TILES; ++t) {
                    UNROLL
                    for (int r = 0; r < 4; ++r) {
                        const int row = warp * 16 + (lane >> 2) + 8 * (r & 1);
                        PART[row * ROW + t * 8 + (r >> 1) * 4 + (lane & 3)] = SOURCE[t][r][l];
                    }
                }
            }
"""

_SYNC = """
#if defined(__CUDA_ARCH__)
            __syncthreads();
#endif
"""
_NEXT_STAGE = """
            stage = stage == stages ? stages + 2 : stages;
"""

_ACCUMULATE = """
            #pragma unroll 1
            for (int s = 0; s < WARPS; ++s) {
                unsigned right[PAIRS][4][LANES];
                UNROLL
                for (int p = 0; p < PAIRS; ++p) transposed(RIGHT, s, FIRST_P + p, false, right[p]);
                UNROLL
                for (int m = 0; m < ROWS; ++m) {
                    unsigned left[4][LANES];
                    transposed(stage[0], s, FIRST_M + m, true, left);
                    UNROLL
                    for (int p = 0; p < PAIRS; ++p) {
                        multiply_add(SUM[m][2 * p], left, right[p]);
                        multiply_add(SUM[m][2 * p + 1], left, right[p] + 2);
                    }
                }
            }
"""

_KEEP = """
    EACH_LANE {
        UNROLL
        for (int m = 0; m < ROWS; ++m) {
            UNROLL
            for (int n = 0; n < 2 * PAIRS; ++n) {
                UNROLL
                for (int r = 0; r < 4; ++r) {
                    const int row = (FIRST_M + m) * 16 + (lane >> 2) + 8 * (r >> 1);
                    const int column = (FIRST_P * 2 + n) * 8 + 2 * (lane & 3) + (r & 1);
                    slots[OFFSET + row * COLUMNS + column] = SUM[m][n][r][l];
                }
            }
        }
    }
"""

_READ_X = """
            EACH_LANE {
                const unsigned* from = reinterpret_cast<const unsigned*>(encoded.data) + (size_t)unit * 256;
                UNROLL
                for (int t = 0; t < 2; ++t) {
                    if (here) read_four(from + (t * 32 + lane) * 4, x[t], l);
                    else x[t][0][l] = x[t][1][l] = x[t][2][l] = x[t][3][l] = 0u;
                }
            }
"""

_BACKWARD = """
#if defined(__CUDA_ARCH__)
    constexpr int WARPS = CUDA_WARPS;
    __shared__ __align__(16) unsigned stages[4][WARPS * 16 * ROW], early[WARPS * 16 * ROW];
    const int warp = threadIdx.x >> 5, block = thread / (32 * WARPS), blocks = threads / (32 * WARPS);
#else
    constexpr int WARPS = 1;
    unsigned stages[4][WARPS * 16 * ROW], early[WARPS * 16 * ROW];
    const int warp = 0, block = thread, blocks = threads;
#endif
    // Which part of each matrix's gradient this warp sums: rows and pairs of tiles of columns.
    constexpr int SPLIT = WARPS == 4 ? 2 : 1;
    constexpr int M3 = OUTPUT_PAIRS, P3 = 4 / WARPS, M2 = 4 / SPLIT, P2 = 4 / SPLIT, M1 = 4 / SPLIT, P1 = 2 / SPLIT;
    const int half_m = warp % SPLIT, half_p = warp / SPLIT;
    float sum3[M3][2 * P3][4][LANES] = {}, sum2[M2][2 * P2][4][LANES] = {}, sum1[M1][2 * P1][4][LANES] = {};
    const float* toward = reinterpret_cast<const float*>(directions.data);
    const unsigned* weights = reinterpret_cast<const unsigned*>(packed.data);
    const float scaled = scale.data[0];
    const int across = (width + (1 << shift) - 1) >> shift;
    const int units = across * ((height + (16 >> shift) - 1) >> (4 - shift)) * hits;
    // Two pairs of stages take turns, so that one barrier a layer suffices.
    unsigned (*stage)[WARPS * 16 * ROW] = stages;
    #pragma unroll 1
    for (int first = block * WARPS; first < units; first += blocks * WARPS) {
            const int unit = first + warp, tile = unit / hits, hit = unit % hits;
            const bool here = unit < units;
            unsigned x[2][4][LANES], y[4][4][LANES], z[4][4][LANES], g[OUTPUT_PAIRS][4][LANES];
            {
PIXELS
            EACH_LANE {
                UNROLL
                for (int i = 0; i < 2; ++i) {
                    const size_t point = (size_t)pixel[i][l] * hits + hit;
                    float grad[3] = {};
                    if (here && pixel[i][l] >= 0) {
                        UNROLL
                        for (int c = 0; c < 3; ++c) {
                            grad[c] = reinterpret_cast<const float*>(grad_colors.data)[3 * point + c] * scaled;
                            if (colors.shape[0] == 0) continue;
                            const float color = reinterpret_cast<const float*>(colors.data)[3 * point + c];
                            if (!(color > 0.0f)) grad[c] = 0.0f;
                        }
                    }
                    float value[4 * OUTPUT_PAIRS] = {};
                    UNROLL
                    for (int u = 0; u < 3 * MINE; ++u) value[u] = grad[u % 3] * b[i][u / 3][l];
                    UNROLL
                    for (int t = 0; t < OUTPUT_PAIRS; ++t) {
                        g[t][i][l] = halves(value[4 * t], value[4 * t + 1]);
                        g[t][2 + i][l] = halves(value[4 * t + 2], value[4 * t + 3]);
                    }
                }
            }
            }
READ_X
BODY
    }
    float* slots = grad_matrices.data + (size_t)block * SUMS;
"""


def _staged(part: str, source: str, tiles: int) -> str:
    return _STAGE.replace("PART", part).replace("SOURCE", source).replace("TILES", str(tiles))


def _summed(text: str, number: int, columns: int = 0, offset: int = 0) -> str:
    """Fill in which sums of matrix gradient `number` a warp holds, and where the layer's input is."""
    first_m, first_p = ("0", f"warp * P{number}") if number == 3 else (f"half_m * M{number}", f"half_p * P{number}")
    names = {
        "FIRST_M": f"({first_m})",
        "FIRST_P": f"({first_p})",
        "ROWS": f"M{number}",
        "PAIRS": f"P{number}",
        "COLUMNS": str(columns),
        "OFFSET": str(offset),
        "SUM": f"sum{number}",
        "RIGHT": "early" if number == 2 else "stage[1]",
    }
    for name, value in names.items():
        text = text.replace(name, value)
    return text


def forward_text(features: int) -> str:
    """Return the text of the forward pass, for F = 2 or 4."""
    at = offsets()
    layers = product("x", f"weights + {at['W1']}", 2, 8, _HIDDEN.replace("OUT", "y"))
    layers += product("y", f"weights + {at['W2']}", 4, 8, _HIDDEN.replace("OUT", "z"))
    layers += product("z", f"weights + {at['W3']}", 4, 6, _EVALUATE)
    head = _constants(F=features, MINE=4, WORDS=at["W3T"])
    return PRELUDE + head + _BASIS + _LOOKUP + _FORWARD.replace("PIXELS", _PIXELS).replace("LAYERS", layers)


def backward_text(features: int) -> str:
    """Return the text of the backward pass down to the features, for F = 2 or 4."""
    at = offsets()
    body = product("x", f"weights + {at['W1']}", 2, 8, _HIDDEN.replace("OUT", "y"))
    body += product("y", f"weights + {at['W2']}", 4, 8, _HIDDEN.replace("OUT", "z"))
    body += _staged("early", "y", 4) + _staged("stage[0]", "g", 3) + _staged("stage[1]", "z", 4) + _SYNC
    body += _summed(_ACCUMULATE, 3)
    body += "unsigned dz[4][4][LANES], dy[4][4][LANES], even[2][LANES];"
    masked = _MASKED.replace("LAYER", "z[n >> 1][(n & 1) * 2 + i][l]").replace("OUT", "dz")
    body += product("g", f"weights + {at['W3T']}", 3, 8, masked)
    body += _NEXT_STAGE + _staged("stage[0]", "dz", 4) + _SYNC + _summed(_ACCUMULATE, 2)
    masked = _MASKED.replace("LAYER", _EARLY).replace("OUT", "dy")
    body += product("dz", f"weights + {at['W2T']}", 4, 8, masked)
    body += _NEXT_STAGE + _READ_X + _staged("stage[0]", "dy", 4) + _staged("stage[1]", "x", 2) + _SYNC
    body += _summed(_ACCUMULATE, 1)
    body += product("dy", f"weights + {at['W1T']}", 4, 4, _FEATURES) + _NEXT_STAGE
    text = _BACKWARD.replace("PIXELS", _PIXELS).replace("READ_X", _READ_X).replace("BODY", body)
    text += _summed(_KEEP, 1, FEATURES, 0)
    text += _summed(_KEEP, 2, WIDTH, GRADIENTS[0])
    text += _summed(_KEEP, 3, WIDTH, GRADIENTS[0] + GRADIENTS[1])
    head = _constants(
        F=features,
        MINE=4,
        OUTPUT_PAIRS=3,
        CUDA_WARPS=WARPS,
        ROW=36,  # words: rows of 64 halves, padded so that eight of them lie in different banks
        SUMS=sum(GRADIENTS),
    )
    return PRELUDE + head + TRANSPOSED + _BASIS + text
