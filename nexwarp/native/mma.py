"""Matrix products of a warp on tensor cores, as lambdas for a CUDA snippet that begins with `PRELUDE`.

Fragments are those of `mma.sync.m16n8k16`, g = lane / 4, q = lane % 4, two halves in a word:

    A (16, 16)  words 0 to 3: rows g + 8 (r & 1), columns 2 q, 2 q + 1 plus 8 (r >> 1)
    B (16, 8)   words 0 and 1: rows 2 q, 2 q + 1 plus 8 r, column g
    D (16, 8)   floats 0 to 3: row g + 8 (r >> 1), column 2 q + (r & 1)

D of one product, rounded to half, is A of the next: tiles 2 k and 2 k + 1 of D make tile k of A.
"""

PRELUDE = """
    const int lane = threadIdx.x & 31;
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
"""

# Two tiles of the inner dimension share a load of four words of a packed matrix. Two tiles of columns take turns: a
# product waits for the one before it in its own tile alone.
PRODUCTS = """
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
    auto read_four = [](const unsigned* from, unsigned* to) {
        const uint4 x = *reinterpret_cast<const uint4*>(from);
        to[0] = x.x; to[1] = x.y; to[2] = x.z; to[3] = x.w;
    };
    auto multiply_add = [](float* d, const unsigned* a, const unsigned* b) {
        asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 "
            "{%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
            : "+f"(d[0]), "+f"(d[1]), "+f"(d[2]), "+f"(d[3])
            : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b[0]), "r"(b[1]));
    };
    // Fragments `source` times a packed matrix of `tiles` tiles of columns; use(n, D) takes tile n of the result.
    auto product = [&](const auto& source, const unsigned* matrix, int tiles, auto use) {
        constexpr int INNER = sizeof(source) / sizeof(source[0]), PAIRS = (INNER + 1) / 2;
        #pragma unroll
        for (int n = 0; n < tiles; n += 2) {
            float sums[2][4] = {};
            #pragma unroll
            for (int k = 0; k < PAIRS; ++k) {
                unsigned b[2][4];
                #pragma unroll
                for (int i = 0; i < 2; ++i) read_four(matrix + (((n + i) * PAIRS + k) * 32 + lane) * 4, b[i]);
                #pragma unroll
                for (int i = 0; i < 2; ++i) multiply_add(sums[i], source[2 * k], b[i]);
                #pragma unroll
                for (int i = 0; i < 2; ++i)
                    if (2 * k + 1 < INNER) multiply_add(sums[i], source[2 * k + 1 < INNER ? 2 * k + 1 : 0], b[i] + 2);
            }
            #pragma unroll
            for (int i = 0; i < 2; ++i) use(n + i, sums[i]);
        }
    };
"""

# A (16, 16) or B (16, 16: two tiles of columns) from rows of points in shared memory, transposed on the way.
# `stage` has rows of ROW words, two halves each; `s` is the tile of points, `tile` that of columns.
TRANSPOSED = """
    auto transposed = [&](const unsigned* stage, int s, int tile, bool is_a, unsigned* to) {
        const int first = (lane >> 3) & 1, second = lane >> 4;
        const int point = s * 16 + (lane & 7) + 8 * (is_a ? second : first);
        const unsigned* from = stage + point * ROW + tile * 8 + 4 * (is_a ? first : second);
        const unsigned address = (unsigned)__cvta_generic_to_shared(from);
        asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
            : "=r"(to[0]), "=r"(to[1]), "=r"(to[2]), "=r"(to[3]) : "r"(address));
    };
"""
