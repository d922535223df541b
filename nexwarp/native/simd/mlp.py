"""Text of the MLP with SH colours on a CPU, a program for one run of points; see `nexwarp.kernels.cpu.mlp`.

Points are worked on in blocks of four SIMD vectors. A block's values are rows of a buffer, a row a feature or neuron.
Rows are taken four at a time: those that fill up the last four are computed like the last one, and not used.
"""

from nexwarp.kernels.sh_terms import basis_terms

BLOCKS = 2  # of points, whose share of a matrix's gradient is added up in registers
MOST_ROWS = 128  # of a layer, filled up
MOST_KEPT = 256  # inputs of all layers together, filled up


def width_of(real: str) -> int:
    """Elements of a SIMD vector: as many as an AVX-512 register holds."""
    return {"float": 16, "double": 8}[real]


def points_of(real: str) -> int:
    """Points of a block."""
    return 4 * width_of(real)


_PRELUDE = """
    typedef REAL reals_t __attribute__((ext_vector_type(WIDTH)));
    constexpr int POINTS = 4 * WIDTH;
#if defined(__AVX512F__)
    constexpr int COLUMNS = 4;  // vectors of a row that are worked on at once
#else  // fewer or smaller registers
    constexpr int COLUMNS = 1;
#endif
    auto load = [](const REAL* from) {
        reals_t v;
        __builtin_memcpy(&v, from, sizeof(v));
        return v;
    };
    auto store = [](REAL* to, reals_t v) { __builtin_memcpy(to, &v, sizeof(v)); };
    auto filled = [](int rows) { return (rows + 3) & ~3; };
    auto smaller = [](int a, int b) { return a < b ? a : b; };
    // y (rows, POINTS) = matrix @ x (columns, POINTS); element (o, k) of the matrix is at o * along + k * across.
    auto product = [&](const REAL* matrix, int rows, int columns, int along, int across, const REAL* x, REAL* y) {
        for (int o = 0; o < rows; o += 4)
            for (int p = 0; p < POINTS; p += COLUMNS * WIDTH) {
                const REAL* w[4];
                for (int r = 0; r < 4; ++r) w[r] = matrix + smaller(o + r, rows - 1) * along;
                reals_t sum[4][COLUMNS] = {};
                for (int k = 0; k < columns; ++k) {
                    reals_t value[COLUMNS];
                    for (int v = 0; v < COLUMNS; ++v) value[v] = load(x + k * POINTS + p + v * WIDTH);
                    for (int r = 0; r < 4; ++r)
                        for (int v = 0; v < COLUMNS; ++v)
                            sum[r][v] = __builtin_elementwise_fma((reals_t)(w[r][k * across]), value[v], sum[r][v]);
                }
                for (int r = 0; r < 4; ++r)
                    for (int v = 0; v < COLUMNS; ++v) store(y + (o + r) * POINTS + p + v * WIDTH, sum[r][v]);
            }
    };
    // Hidden layer (rows, POINTS) of x: ReLU of the product.
    auto hidden = [&](const REAL* matrix, int rows, int columns, const REAL* x, REAL* y) {
        product(matrix, rows, columns, columns, 1, x, y);
        for (int i = 0; i < filled(rows) * POINTS; i += WIDTH)
            store(y + i, load(y + i) < (reals_t)((REAL)0) ? (reals_t)((REAL)0) : load(y + i));  // NaN stays NaN
    };
    // Features of a block, 0 beyond the last point.
    auto read_features = [&](int start, int last, REAL* to) {
        const int there = smaller(last - start, POINTS);
        for (int k = 0; k < sizes.data[0]; ++k) {
            const REAL* from = &wp::index(encoded, k, start);
            for (int p = 0; p < there; ++p) to[k * POINTS + p] = from[p];
            for (int p = there; p < POINTS; ++p) to[k * POINTS + p] = (REAL)0;
        }
    };
    // Basis functions (COUNT, WIDTH) at the directions of the points from `start` on; beyond the last point, its own.
    auto basis = [&](int start, int last, reals_t* out) {
        reals_t x, y, z;
        int direction = start / hits, hit = start - direction * hits;
        #pragma unroll
        for (int l = 0; l < WIDTH; ++l) {
            const auto& toward = directions.data[direction];
            x[l] = toward[0];
            y[l] = toward[1];
            z[l] = toward[2];
            if (start + l + 1 < last && ++hit == hits) {
                hit = 0;
                ++direction;
            }
        }
        const reals_t xx = x * x, yy = y * y, zz = z * z, one = (reals_t)((REAL)1);
        const reals_t all[] = {TERMS};
        for (int k = 0; k < COUNT; ++k) out[k] = all[k];
    };
"""

_FORWARD = """
    __attribute__((aligned(64))) REAL buffers[2][MOST_ROWS * POINTS];
    for (int start = first; start < last; start += POINTS) {
        REAL *x = buffers[0], *y = buffers[1];
        read_features(start, last, x);
        const REAL* matrix = matrices.data;
        for (int i = 0; i < layers; ++i) {
            const int columns = sizes.data[i], rows = sizes.data[i + 1];
            if (i + 1 < layers)
                hidden(matrix, rows, columns, x, y);
            else
                product(matrix, rows, columns, columns, 1, x, y);
            matrix += rows * columns;
            REAL* swap = x;
            x = y;
            y = swap;
        }
        for (int p = 0; p < POINTS && start + p < last; p += WIDTH) {
            reals_t b[COUNT], color[3];
            basis(start + p, last, b);
            for (int c = 0; c < 3; ++c) {
                color[c] = (reals_t)(offset);
                for (int k = 0; k < COUNT; ++k)
                    color[c] = __builtin_elementwise_fma(load(x + (3 * k + c) * POINTS + p), b[k], color[c]);
                if (clamp) color[c] = __builtin_elementwise_max(color[c], (reals_t)((REAL)0));
            }
            const int there = smaller(last - start - p, WIDTH);
            for (int l = 0; l < there; ++l)
                for (int c = 0; c < 3; ++c) colors.data[start + p + l][c] = color[c][l];
        }
    }
"""

_BACKWARD = """
    // sums (rows, columns) += a (rows, points) @ b (columns, points).T, over all blocks.
    auto outer = [&](const REAL* a, int rows, const REAL* b, int columns, REAL* sums) {
        for (int o = 0; o < rows; o += 4)
            for (int k = 0; k < columns; k += COLUMNS) {
                reals_t sum[COLUMNS][4] = {};
                for (int block = 0; block < BLOCKS; ++block) {
                    const REAL* from_a = a + (block * filled(rows) + o) * POINTS;
                    const REAL* from_b = b + block * filled(columns) * POINTS;
                    for (int p = 0; p < POINTS; p += WIDTH) {
                        reals_t value[4];
                        for (int r = 0; r < 4; ++r) value[r] = load(from_a + r * POINTS + p);
                        for (int v = 0; v < COLUMNS; ++v) {
                            const reals_t other = load(from_b + (k + v) * POINTS + p);
                            for (int r = 0; r < 4; ++r)
                                sum[v][r] = __builtin_elementwise_fma(value[r], other, sum[v][r]);
                        }
                    }
                }
                for (int v = 0; v < COLUMNS && k + v < columns; ++v) {
                    const reals_t four = fold(sum[v][0], sum[v][1], sum[v][2], sum[v][3]);
                    for (int r = 0; r < 4 && o + r < rows; ++r) sums[(o + r) * columns + k + v] += four[r];
                }
            }
    };
    __attribute__((aligned(64))) REAL kept[MOST_KEPT * BLOCKS * POINTS], signals[2][MOST_ROWS * BLOCKS * POINTS];
    for (int start = first; start < last; start += BLOCKS * POINTS) {
        REAL *x = kept, *signal = signals[0], *next = signals[1];
        const REAL* matrix = matrices.data;
        for (int i = 0; i < layers; ++i) {  // the inputs of all layers, once more
            const int columns = sizes.data[i], rows = sizes.data[i + 1], size = filled(columns) * POINTS;
            for (int block = 0; block < BLOCKS; ++block) {
                if (i == 0) read_features(smaller(start + block * POINTS, last), last, x + block * size);
                if (i + 1 < layers)
                    hidden(matrix, rows, columns, x + block * size, x + BLOCKS * size + block * filled(rows) * POINTS);
            }
            if (i + 1 < layers) {
                x += BLOCKS * size;
                matrix += rows * columns;
            }
        }
        const int outputs = sizes.data[layers];
        for (int p = 0; p < BLOCKS * POINTS; p += WIDTH) {  // gradients of the coefficients
            REAL* to = signal + p / POINTS * filled(outputs) * POINTS + p % POINTS;
            reals_t b[COUNT], grad[3] = {};
            if (start + p < last) {
                basis(start + p, last, b);
                #pragma unroll
                for (int l = 0; l < WIDTH; ++l)
                    for (int c = 0; c < 3; ++c) {
                        const int i = start + p + l;
                        const bool counts = i < last && (!clamp || colors.data[i][c] > (REAL)0);
                        grad[c][l] = counts ? grad_colors.data[i][c] : (REAL)0;
                    }
            }
            for (int k = 0; k < COUNT; ++k)
                for (int c = 0; c < 3; ++c)
                    store(to + (3 * k + c) * POINTS, start + p < last ? grad[c] * b[k] : (reals_t)((REAL)0));
        }
        REAL* sums = &wp::index(grad_matrices, part, 0) + (matrix - matrices.data);
        for (int i = layers - 1; i >= 0; --i) {
            const int columns = sizes.data[i], rows = sizes.data[i + 1], size = filled(columns) * POINTS;
            outer(signal, rows, x, columns, sums);
            for (int block = 0; block < BLOCKS; ++block) {
                REAL* to = next + block * size;
                product(matrix, columns, rows, 1, columns, signal + block * filled(rows) * POINTS, to);
                if (i > 0)
                    for (int j = 0; j < size; j += WIDTH) {
                        const reals_t zero = (reals_t)((REAL)0);
                        store(to + j, load(x + block * size + j) <= zero ? zero : load(to + j));
                    }
            }
            if (i > 0) {
                const int before = sizes.data[i - 1];
                x -= BLOCKS * filled(before) * POINTS;
                matrix -= columns * before;
                sums -= columns * before;
            }
            REAL* swap = signal;
            signal = next;
            next = swap;
        }
        for (int block = 0; block < BLOCKS; ++block) {
            const int here = start + block * POINTS, there = smaller(last - here, POINTS);
            for (int k = 0; k < sizes.data[0] && there > 0; ++k) {
                REAL* to = &wp::index(grad_encoded, k, here);
                const REAL* from = signal + (block * filled(sizes.data[0]) + k) * POINTS;
                for (int p = 0; p < there; ++p) to[p] = from[p];
            }
        }
    }
"""


def _fold(width: int) -> str:
    """Return the text of `fold`: a vector that begins with the sums of the elements of four vectors."""

    def shuffled(a: str, b: str, which: int, size: int, pieces: int) -> str:
        """Text of the first or second halves of the `pieces` parts of `size` elements, of a and then of b."""
        half = size // 2
        parts = [source * width + piece * size + which * half for source in (0, 1) for piece in range(pieces)]
        places = [str(part + i) for part in parts for i in range(half)]
        return f"__builtin_shufflevector({a}, {b}, {', '.join(places * (width // len(places)))})"

    def added(a: str, b: str, size: int, pieces: int) -> str:
        return f"({shuffled(a, b, 0, size, pieces)} + {shuffled(a, b, 1, size, pieces)})"

    text = [
        f"        const reals_t ab = {added('a', 'b', width, 1)};",
        f"        const reals_t cd = {added('c', 'd', width, 1)};",
        f"        reals_t v = {added('ab', 'cd', width // 2, 2)};",
    ]
    size = width // 4
    while size > 1:
        text.append(f"        v = {added('v', 'v', size, 4)};")
        size //= 2
    body = "\n".join(text)
    return f"    auto fold = [](reals_t a, reals_t b, reals_t c, reals_t d) {{\n{body}\n        return v;\n    }};\n"


def _text(body: str, real: str, degree: int) -> str:
    width = width_of(real)
    terms = ", ".join(basis_terms(degree, suffix="f" if real == "float" else "", one="one"))
    text = _PRELUDE + body
    for name, value in (
        ("TERMS", terms),
        ("WIDTH", width),
        ("COUNT", (degree + 1) ** 2),
        ("BLOCKS", BLOCKS),
        ("MOST_ROWS", MOST_ROWS),
        ("MOST_KEPT", MOST_KEPT),
        ("REAL", real),
    ):
        text = text.replace(name, str(value))
    return text


def forward_text(real: str, degree: int) -> str:
    """Return the body of the forward function: colours of the points from `first` to `last`."""
    return _text(_FORWARD, real, degree)


def backward_text(real: str, degree: int) -> str:
    """Return the body of the backward function: gradients of the points from `first` to `last`."""
    return _text(_fold(width_of(real)) + _BACKWARD, real, degree)
