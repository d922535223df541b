"""The method in dense torch, as the paper writes it: every pixel against every surfel, meant for float64.

Nothing here is shared with nexwarp: where both agree, both are likely right.
"""
