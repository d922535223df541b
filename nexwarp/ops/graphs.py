"""Recording of launches, torch's and Warp's alike, as a CUDA graph."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

import torch
import warp as wp

from nexwarp.ops._interop import stream_on


@contextmanager
def captured(graph: torch.cuda.CUDAGraph, stream: torch.cuda.Stream, pool: Any) -> Iterator[None]:
    """Record in `graph` what is launched inside, on `stream`, instead of doing it.

    Memory comes from `pool`, which several graphs may share that are replayed one after another. Unlike
    `torch.cuda.graph` this neither waits for the GPU nor gives cached memory back, so that it is worth doing often.
    Other threads may go on using the GPU.
    """
    stream.wait_stream(torch.cuda.current_stream(stream.device))
    with torch.cuda.stream(stream):
        graph.capture_begin(pool=pool, capture_error_mode="thread_local")
        ours = stream_on(stream)
        try:
            # Lets Warp take the temporary memory of its sorts from the graph.
            wp.capture_begin(stream=ours, external=True, capture_mode=wp.CaptureMode.THREAD_LOCAL)
            yield
            wp.capture_end(stream=ours)
            graph.capture_end()
        except BaseException:
            for end in (partial(wp.capture_end, stream=ours), graph.capture_end):
                with suppress(RuntimeError):  # what went wrong was told
                    end()
            raise
    torch.cuda.current_stream(stream.device).wait_stream(stream)
