"""The neural texture baked into an image: what renderers without a hash grid and an MLP draw. Not in the paper."""
