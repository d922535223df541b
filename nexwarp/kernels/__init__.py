"""What a thread does: pure Warp, no torch, one source for CUDA and CPU.

Symbols, the same in every file of this package:

    means, quats, scales     surfel centre, rotation surfel -> world (wxyz), extents along its x and y axes; world units
    opacities, gammas        o and (g1, g2) of the generalised Gaussian, paper Eq. 3
    viewmat                  world -> camera (4, 4); x right, y down, z forward
    fx, fy, cx, cy           intrinsics in pixels; pixel centres lie at +0.5
    d                        direction of a pixel's ray in the camera frame, d.z = 1, so that t is z-depth
    u, v, t                  the hit in the surfel's own axes (in units of its scales) and its z-depth
    alpha, transmittance     weight = transmittance * alpha
    K                        length of the hit buffer (max_hits); id -1, weight 0, depth 0 mark an empty slot
    n                        number of texture points, H * W * K

Words, each with one meaning:

    thread              one execution of a kernel's body: a GPU thread, or one turn of a CPU's loop
    warp, lane          32 GPU threads that run together, and a thread's index among them (native/warp.py); on a CPU a
                        warp is one thread
    entry               one (tile, surfel) pair of the tile lists; `k` is the place of an entry in the walk
    gradient slot       where one entry's gradient is added up, before `reduce` adds up each surfel's
    tile polygon        a surfel's support as projected to the image, which decides its tiles
    fixed point         sums as integers, which do not depend on the order of their terms (native/fixed_point.py)

Each file's header is its contract: what a thread is, what is read and written, what is differentiated and what is
frozen, and where the paper defines it.

Functions stand at the top level and serve float32 and float64, which is what the proofs use: their annotations, such as
`Vec3`, are Any to Warp, and a constant is `type(x)(0.5)`, as Warp takes a Python float as float32. Kernels need their
types: a `@per_real` kernel is written once over those of `types.types`, and others are made by cached factories. The
length of the K-buffer is a name of the kernel.

A kernel's first argument is `first`, the offset of its thread range: a CPU launch is one serial loop, so `launch.py`
splits the range over Python threads. Whatever is written is therefore owned by one thread: no kernel relies on CPU
atomics across the split.
"""
