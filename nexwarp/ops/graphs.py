"""Recording of launches, torch's and Warp's alike, as CUDA graphs."""

import gc
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import torch
import warp as wp

from nexwarp.ops._interop import stream_on, warp_streams


@contextmanager
def captured(graph: torch.cuda.CUDAGraph, stream: torch.cuda.Stream, pool: Any) -> Iterator[None]:
    """Record in `graph` what is launched inside, on `stream`, instead of doing it.

    Memory comes from `pool`, which several graphs may share that are replayed one after another. Unlike
    `torch.cuda.graph` this neither waits for the GPU nor gives cached memory back, so that it is worth doing often.
    Other threads may go on using the GPU, but not wait for the whole of it; where they render, they wait for the end.
    """
    ours = stream_on(stream)  # before: Warp may have to start first
    stream.wait_stream(torch.cuda.current_stream(stream.device))
    with warp_streams, torch.cuda.stream(stream), _no_collection():
        graph.capture_begin(pool=pool, capture_error_mode="thread_local")
        try:
            # Lets Warp take the temporary memory of its sorts from the graph.
            wp.capture_begin(stream=ours, external=True, capture_mode=wp.CaptureMode.THREAD_LOCAL)
            yield
            wp.capture_end(stream=ours)
            graph.capture_end()
        except BaseException:
            # What went wrong was told.
            with suppress(RuntimeError):
                wp.capture_end(stream=ours)
            try:
                with warnings.catch_warnings():
                    warnings.filterwarnings("ignore", "The CUDA Graph is empty")  # nothing was launched before it
                    graph.capture_end()
            except Exception:
                # torch then leaves its allocator, in some versions, and its random generator as if still capturing.
                newer, older = "_cuda_endAllocateToPool", "_cuda_endAllocateCurrentStreamToPool"  # older: torch 2.4
                with suppress(RuntimeError):
                    getattr(torch._C, newer if hasattr(torch._C, newer) else older)(stream.device_index, pool)
                generator = torch.cuda.default_generators[stream.device_index]
                generator.graphsafe_set_state(generator.clone_state())
            raise
    torch.cuda.current_stream(stream.device).wait_stream(stream)


@contextmanager
def _no_collection() -> Iterator[None]:
    """Keep Python from collecting garbage: freeing other graphs in the middle of a capture may invalidate it."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
