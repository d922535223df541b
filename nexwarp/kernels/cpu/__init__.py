"""SIMD forms of two stages, for the CPU."""
