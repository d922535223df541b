"""Matrix products of a warp on tensor cores, and their emulation on a CPU.

A snippet that begins with `PRELUDE` is the program of one warp. What a lane holds has one more dimension, `[LANES]`:
on CUDA it is 1 and the lanes are threads, on a CPU it is 32 and one thread does all lanes in turns. `EACH_LANE` runs a
statement for every lane, with `lane` its index and `l` its place in such arrays. So a CPU executes the same text, the
same fragments and the same index arithmetic.

Fragments are those of `mma.sync.m16n8k16`, g = lane / 4, q = lane % 4, two halves in a word:

    A (16, 16)  words 0 to 3: rows g + 8 (r & 1), columns 2 q, 2 q + 1 plus 8 (r >> 1)
    B (16, 8)   words 0 and 1: rows 2 q, 2 q + 1 plus 8 r, column g
    D (16, 8)   floats 0 to 3: row g + 8 (r >> 1), column 2 q + (r & 1)

D of one product, rounded to half, is A of the next: tiles 2 k and 2 k + 1 of D make tile k of A.
"""

PRELUDE = """
#if defined(__CUDA_ARCH__)
#define UNROLL _Pragma("unroll")
    constexpr int LANES = 1;
    const int lane0 = threadIdx.x & 31;
    auto low_half = [](unsigned x) {
        float y;
        asm("{.reg .f16 a, b; mov.b32 {a, b}, %1; cvt.f32.f16 %0, a;}" : "=f"(y) : "r"(x));
        return y;
    };
    auto high_half = [](unsigned x) {
        float y;
        asm("{.reg .f16 a, b; mov.b32 {a, b}, %1; cvt.f32.f16 %0, b;}" : "=f"(y) : "r"(x));
        return y;
    };
    auto halves = [](float a, float b) {
        unsigned y;
        asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(y) : "f"(b), "f"(a));
        return y;
    };
    auto relu_halves = [](float a, float b) {
        unsigned y;
        asm("cvt.rn.relu.f16x2.f32 %0, %1, %2;" : "=r"(y) : "f"(b), "f"(a));
        return y;
    };
    auto read_four = [](const unsigned* from, unsigned (*to)[1], int) {
        const uint4 x = *reinterpret_cast<const uint4*>(from);
        to[0][0] = x.x; to[1][0] = x.y; to[2][0] = x.z; to[3][0] = x.w;
    };
    auto write_four = [](unsigned* to, unsigned (*from)[1], int) {
        *reinterpret_cast<uint4*>(to) = make_uint4(from[0][0], from[1][0], from[2][0], from[3][0]);
    };
    auto multiply_add = [](wp::float32 (*d)[1], const unsigned (*a)[1], const unsigned (*b)[1]) {
        asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
            "{%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
            : "+f"(d[0][0]), "+f"(d[1][0]), "+f"(d[2][0]), "+f"(d[3][0])
            : "r"(a[0][0]), "r"(a[1][0]), "r"(a[2][0]), "r"(a[3][0]), "r"(b[0][0]), "r"(b[1][0]));
    };
    auto sum_over_q = [](float* x) {
        x[0] += __shfl_xor_sync(0xffffffffu, x[0], 1);
        x[0] += __shfl_xor_sync(0xffffffffu, x[0], 2);
    };
    auto any_lane = [](const int* x) { return __any_sync(0xffffffffu, x[0]); };
    auto swap_lanes = [](const auto* x, int bit, auto* to) {
        to[0] = __shfl_xor_sync(0xffffffffu, x[0], bit);
    };
    auto vote = [](const int* x) { return __ballot_sync(0xffffffffu, x[0]); };
    auto equal_lanes = [](const wp::int32 (*x)[1], unsigned* to) {
        const unsigned long long xy = ((unsigned long long)(unsigned)x[1][0] << 32) | (unsigned)x[0][0];
        to[0] = __match_any_sync(0xffffffffu, xy) & __match_any_sync(0xffffffffu, x[2][0]);
    };
    auto power_of_e = [](float x) { return __expf(x); };
    auto exponential2 = [](float x) {
        float y;
        asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
        return y;
    };
    auto reciprocal = [](float x) {
        float y;
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
        return y;
    };
    // An address that the compiler adds an index to by one instruction, as it does not know how it came about.
    auto opaque = [](const auto* x) {
        asm volatile("" : "+l"(x));
        return x;
    };
#else
#define UNROLL
    constexpr int LANES = 32;
    const int lane0 = 0;
    auto one_half = [](unsigned x) { wp::half y; y.u = (unsigned short)x; return wp::half_to_float(y); };
    auto low_half = [&](unsigned x) { return one_half(x & 0xffffu); };
    auto high_half = [&](unsigned x) { return one_half(x >> 16); };
    auto halves = [](float a, float b) {
        return (unsigned)wp::float_to_half(a).u | ((unsigned)wp::float_to_half(b).u << 16);
    };
    auto relu_halves = [&](float a, float b) { return halves(a < 0.0f ? 0.0f : a, b < 0.0f ? 0.0f : b); };
    auto read_four = [](const unsigned* from, unsigned (*to)[32], int l) {
        for (int r = 0; r < 4; ++r) to[r][l] = from[r];
    };
    auto write_four = [](unsigned* to, unsigned (*from)[32], int l) {
        for (int r = 0; r < 4; ++r) to[r] = from[r][l];
    };
    // Not inlined: it would be as often as the text has products, and compile for a minute.
    auto multiply_add = [&](wp::float32 (*d)[32], const unsigned (*a)[32],
                            const unsigned (*b)[32]) __attribute__((noinline)) {
        float left[16][16], right[16][8];
        for (int lane = 0; lane < 32; ++lane) {
            const int g = lane >> 2, q = lane & 3;
            for (int r = 0; r < 4; ++r) {
                left[g + 8 * (r & 1)][2 * q + 8 * (r >> 1)] = low_half(a[r][lane]);
                left[g + 8 * (r & 1)][2 * q + 1 + 8 * (r >> 1)] = high_half(a[r][lane]);
            }
            for (int r = 0; r < 2; ++r) {
                right[2 * q + 8 * r][g] = low_half(b[r][lane]);
                right[2 * q + 1 + 8 * r][g] = high_half(b[r][lane]);
            }
        }
        for (int lane = 0; lane < 32; ++lane) {
            for (int r = 0; r < 4; ++r) {
                const int row = (lane >> 2) + 8 * (r >> 1), column = 2 * (lane & 3) + (r & 1);
                for (int k = 0; k < 16; ++k) d[r][lane] += left[row][k] * right[k][column];
            }
        }
    };
    auto sum_over_q = [](float* x) {
        for (int lane = 0; lane < 32; lane += 4) {
            const float sum = (x[lane] + x[lane + 1]) + (x[lane + 2] + x[lane + 3]);
            for (int q = 0; q < 4; ++q) x[lane + q] = sum;
        }
    };
    auto any_lane = [](const int* x) {
        int any = 0;
        for (int lane = 0; lane < 32; ++lane) any |= x[lane];
        return any;
    };
    auto swap_lanes = [](const auto* x, int bit, auto* to) {
        for (int lane = 0; lane < 32; ++lane) to[lane] = x[lane ^ bit];
    };
    auto vote = [](const int* x) {
        unsigned lanes = 0;
        for (int lane = 0; lane < 32; ++lane) lanes |= (unsigned)(x[lane] != 0) << lane;
        return lanes;
    };
    auto equal_lanes = [](const wp::int32 (*x)[32], unsigned* to) {
        for (int lane = 0; lane < 32; ++lane) {
            to[lane] = 0;
            for (int i = 0; i < 32; ++i)
                to[lane] |= (unsigned)(x[0][i] == x[0][lane] && x[1][i] == x[1][lane] && x[2][i] == x[2][lane]) << i;
        }
    };
    auto power_of_e = [](float x) { return expf(x); };
    auto exponential2 = [](float x) { return exp2f(x); };
    auto reciprocal = [](float x) { return 1.0f / x; };
    auto opaque = [](const auto* x) { return x; };
#endif
#define EACH_LANE for (int l = 0, lane = lane0; l < LANES; ++l, ++lane)
"""

# A product of fragments with packed matrices; CONSUME uses D of tile n. Two tiles of k share a load of four words.
# Several tiles of columns take turns: a product waits for the one before it in its own tile alone.
_PRODUCT = """
    UNROLL
    for (int first_n = 0; first_n < N_TILES; first_n += TURNS) {
        wp::float32 sums[TURNS][4][LANES] = {};
        UNROLL
        for (int k = 0; k < K_PAIRS; ++k) {
            unsigned b[TURNS][4][LANES];
            UNROLL
            for (int i = 0; i < TURNS; ++i)
                EACH_LANE read_four(WEIGHTS + (((first_n + i) * K_PAIRS + k) * 32 + lane) * 4, b[i], l);
            UNROLL
            for (int i = 0; i < TURNS; ++i) multiply_add(sums[i], SOURCE[2 * k], b[i]);
            UNROLL
            for (int i = 0; i < TURNS; ++i)
                if (2 * k + 1 < K_TILES) multiply_add(sums[i], SOURCE[2 * k + 1 < K_TILES ? 2 * k + 1 : 0], b[i] + 2);
        }
        UNROLL
        for (int i = 0; i < TURNS; ++i) {
            const int n = first_n + i;
            wp::float32 (*d)[LANES] = sums[i];
            CONSUME
        }
    }
"""


def product(source: str, weights: str, k_tiles: int, n_tiles: int, consume: str, turns: int = 2) -> str:
    """Return the text of a product of fragments `source[k_tiles]` with a packed matrix of `n_tiles` tiles of columns.

    Args:
        source: name of an array of A fragments, unsigned [k_tiles][4][LANES].
        weights: expression of the address of a matrix as `fused_texture` packs it.
        k_tiles: tiles of 16 of the inner dimension.
        n_tiles: tiles of 8 columns.
        consume: statements that use D, float d[4][LANES], of tile n.
        turns: how many tiles of columns take turns; divides n_tiles.
    """
    text = _PRODUCT.replace("CONSUME", consume).replace("SOURCE", source).replace("WEIGHTS", weights)
    text = text.replace("N_TILES", str(n_tiles)).replace("K_PAIRS", str((k_tiles + 1) // 2))
    return text.replace("K_TILES", str(k_tiles)).replace("TURNS", str(turns))


# A (16, 16) or B (16, 16: two tiles of columns) from rows of points in shared memory, transposed on the way.
# `stage` has rows of ROW words, two halves each; `s` is the tile of points, `tile` that of columns.
TRANSPOSED = """
#if defined(__CUDA_ARCH__)
    auto transposed = [&](const unsigned* stage, int s, int tile, bool is_a, unsigned (*to)[1]) {
        const int lane = threadIdx.x & 31, first = (lane >> 3) & 1, second = lane >> 4;
        const int point = s * 16 + (lane & 7) + 8 * (is_a ? second : first);
        const unsigned* from = stage + point * ROW + tile * 8 + 4 * (is_a ? first : second);
        const unsigned address = (unsigned)__cvta_generic_to_shared(from);
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
            : "=r"(to[0][0]), "=r"(to[1][0]), "=r"(to[2][0]), "=r"(to[3][0]) : "r"(address));
    };
#else
    auto transposed = [&](const unsigned* stage, int s, int tile, bool is_a, unsigned (*to)[32]) {
        const unsigned short* cells = reinterpret_cast<const unsigned short*>(stage);
        for (int lane = 0; lane < 32; ++lane) {
            for (int r = 0; r < 4; ++r) {
                const int point = s * 16 + 2 * (lane & 3) + 8 * (is_a ? r >> 1 : r & 1);
                const int column = tile * 16 + (lane >> 2) + 8 * (is_a ? r & 1 : r >> 1);
                to[r][lane] = cells[point * ROW * 2 + column] | ((unsigned)cells[(point + 1) * ROW * 2 + column] << 16);
            }
        }
    };
#endif
"""
