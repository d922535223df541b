"""SIMD forms of stages, for the CPU: collection, blended errors, lookup, and the texture's MLP with its SH."""
